"""ISO 9283: the cube, its targets, and the figures, against formulas written anew and arms whose errors are known."""

import json
import math

import numpy as np
import pandas as pd
import pytest
from conftest import ROOT

from casacal import load_problem
from casacal.cli.main import main
from casacal.deployment import read_result, read_targets
from casacal.deployment.compensate import compensate
from casacal.deployment.predict import predict
from casacal.errors import CasacalError, SamplesError
from casacal.planning import Clearance
from casacal.simulation import Disturbances
from casacal.verification import plan_cube, pose_accuracy

ORDER = ["P5", "P4", "P3", "P2", "P1"]
ROOT2 = math.sqrt(2)
POINTS = {  # a cube of 500 mm about (600, 0, 500), whose diagonal plane leans towards x: written out by hand
    "P1": (600, 0, 500),
    "P2": (800, -200, 300),
    "P3": (800, 200, 300),
    "P4": (400, 200, 700),
    "P5": (400, -200, 700),
}


@pytest.fixture(scope="module")
def ur5():
    return load_problem(ROOT / "problems" / "ur5")


@pytest.fixture(scope="module")
def plan(ur5):
    return plan_cube(ur5.problem, centre=(-450, 0, 350), side=300, plane="x+", cell=ur5.cell)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    out = tmp_path_factory.mktemp("truth") / "rows.csv"
    assert main(["simulate", str(ROOT / "problems" / "ur5"), "--samples", "40", "--seed", "4", "--out", str(out)]) == 0
    return read_result(out.with_suffix(".truth.json"))


def visited(seed, cycles=30, std=0.02, off=None, points=POINTS, names=ORDER):
    """Rows of cycles about points that an arm misses by `off`, and scatters about."""
    rng, off = np.random.default_rng(seed), off or {}
    rows = [
        (cycle, name, *(np.array(points[name]) + off.get(name, 0.0) + rng.normal(0, std, 3)))
        for cycle in range(1, cycles + 1)
        for name in names
    ]
    return pd.DataFrame(rows, columns=["cycle", "point", "x_mm", "y_mm", "z_mm"])


def moved(rows, seed=0):
    """The same rows as a tracker sees them that stands anywhere."""
    a, b, c = np.random.default_rng(seed).uniform(-2, 2, 3)
    turn = np.array([[math.cos(a), -math.sin(a), 0], [math.sin(a), math.cos(a), 0], [0, 0, 1]])
    turn = turn @ np.array([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]])
    found = rows.copy()
    found[["x_mm", "y_mm", "z_mm"]] = rows[["x_mm", "y_mm", "z_mm"]].to_numpy() @ turn.T + [3000 * c, 700, -200]
    return found


def at(rows, name):
    return rows.loc[rows["point"] == name, ["x_mm", "y_mm", "z_mm"]].to_numpy(float)


def value(found, name):
    return found.criteria[name].value


def test_the_points_are_those_of_the_standard(plan):
    """Clause 6.8.4: on the diagonals of a plane through opposite edges, a tenth of the diagonal from its ends."""
    corners = -450 + 150 * np.array([1, -1]), 150 * np.array([1, -1]), 350 + 150 * np.array([1, -1])
    (xs, ys, zs), tips = corners, dict(zip(plan.names, plan.tips, strict=True))
    diagonal = 300 * math.sqrt(3)
    ends = [np.array([x, y, z]) for x in xs for y in ys for z in zs]
    for name in ("P2", "P3", "P4", "P5"):
        assert min(np.linalg.norm(tips[name] - end) for end in ends) == pytest.approx(0.1 * diagonal, abs=0.01)
        assert (tips[name] - tips["P1"]) @ [1, 0, 1] == pytest.approx(0, abs=0.01)
        assert np.linalg.norm(tips[name] - tips["P1"]) == pytest.approx(0.4 * diagonal, abs=0.01)
    assert tips["P1"] == pytest.approx((-450, 0, 350), abs=0.01)
    assert tips["P2"] + tips["P4"] == pytest.approx(2 * tips["P1"], abs=0.02)
    assert np.linalg.norm(tips["P2"] - tips["P3"]) == pytest.approx(240, abs=0.01)
    assert tips["L1"] == pytest.approx(tips["P2"], abs=0.01)
    assert tips["L11"] == pytest.approx(tips["P4"], abs=0.01)
    along = np.array([tips[f"L{k}"] for k in range(13)]) - tips["L0"]
    assert np.cross(along, along[-1]) == pytest.approx(0, abs=10)
    assert np.linalg.norm(along[-1]) == pytest.approx(0.84 * diagonal, abs=0.01)


def test_the_arm_takes_the_targets_in_one_posture_with_the_tool_normal_to_the_plane(plan, ur5):
    lower, upper = ur5.problem.robot.limits
    assert ((plan.joints > lower) & (plan.joints < upper)).all()
    assert np.abs(np.diff(plan.joints[5:], axis=0)).max() < 0.6
    assert plan.poses[:, :3, 2] == pytest.approx(np.tile([-1 / ROOT2, 0, -1 / ROOT2], (18, 1)), abs=1e-5)
    assert plan.tips == pytest.approx(plan.poses[:, :3, 3] + 120 * plan.poses[:, :3, 2], abs=1e-6)
    assert plan.tips[:, 2].min() > 100
    assert "table" in plan.words


def test_predict_and_compensate_take_the_targets(plan, ur5, truth, tmp_path):
    (tmp_path / "plan.csv").write_text(plan.text())
    told = predict(truth, tmp_path / "plan.csv", frame="flange", nominal=True)
    assert told.positions == pytest.approx(plan.poses[:, :3, 3], abs=1e-5)
    corrected = compensate(truth, read_targets(tmp_path / "plan.csv", ur5))
    assert corrected.reached.all()
    assert corrected.start == pytest.approx(plan.joints, abs=1e-6)
    tip = compensate(truth, read_targets(tmp_path / "plan.csv", ur5), frame="tip")
    assert predict(truth, tip.joints, frame="tip").positions == pytest.approx(plan.tips, abs=0.006)


@pytest.mark.long
def test_the_largest_cube_is_reached_with_every_corner_and_hardly_larger(ur5):
    found = plan_cube(ur5.problem)
    assert 400 < found.side < 850 / math.sqrt(3) * 2
    again = plan_cube(ur5.problem, centre=found.centre, side=found.side, plane=found.plane)
    assert again.tips == pytest.approx(found.tips, abs=0.02)
    assert found.centre[2] - found.side / 2 >= 0


def test_figures_are_those_of_the_formulas():
    off = {"P1": (0.3, -0.2, 0.1), "P2": (0.0, 0.5, 0.0), "P4": (-0.1, 0.0, 0.7)}
    rows = visited(3, off=off)
    found = pose_accuracy(POINTS, rows, in_base=True)
    for name, place in POINTS.items():
        x, y, z = at(rows, name).T
        ap = math.sqrt((x.mean() - place[0]) ** 2 + (y.mean() - place[1]) ** 2 + (z.mean() - place[2]) ** 2)
        distances = np.sqrt((x - x.mean()) ** 2 + (y - y.mean()) ** 2 + (z - z.mean()) ** 2)
        spread = math.sqrt(((distances - distances.mean()) ** 2).sum() / (len(x) - 1))
        assert value(found, f"AP {name}") == pytest.approx(ap, rel=1e-12)
        assert value(found, f"RP {name}") == pytest.approx(distances.sum() / len(x) + 3 * spread, rel=1e-12)
        assert value(found, f"APy {name}") == pytest.approx(y.mean() - place[1], abs=1e-12)
    apart = np.sqrt(((at(rows, "P2") - at(rows, "P4")) ** 2).sum(axis=1))
    assert value(found, "AD") == pytest.approx(apart.mean() - 400 * math.sqrt(3), rel=1e-9)
    assert value(found, "RD") == pytest.approx(3 * math.sqrt(((apart - apart.mean()) ** 2).sum() / 29), rel=1e-9)
    assert found.frame == "base"
    assert not found.notes
    assert {each.cycles for each in found.criteria.values()} == {30}


@pytest.mark.long
def test_standard_errors_are_those_of_many_tests():
    """What the jackknife says of one test is how much 80 tests differ; RP is that of the chi distribution."""
    tests = [pose_accuracy(POINTS, visited(seed, std=0.05, off={"P1": (1, 0, 0)}), in_base=True) for seed in range(80)]
    for name in ("AP P1", "RP P1", "AD", "RD"):
        each = [test.criteria[name] for test in tests]
        assert np.mean([one.std for one in each]) == pytest.approx(np.std([one.value for one in each]), rel=0.3)
    chi = math.sqrt(8 / math.pi), math.sqrt(3 - 8 / math.pi)
    assert np.mean([value(test, "RP P1") for test in tests]) == pytest.approx(
        0.05 * math.sqrt(29 / 30) * (chi[0] + 3 * chi[1]), rel=0.03
    )
    assert np.mean([value(test, "RD") for test in tests]) == pytest.approx(3 * 0.05 * ROOT2, rel=0.03)


def test_a_tracker_anywhere_is_fitted_and_it_is_said_what_this_hides():
    twist = {name: np.cross([0, 0, 0.002], np.array(place) - 1000) for name, place in POINTS.items()}
    rows = visited(5, off=twist)
    base, fitted = pose_accuracy(POINTS, rows, in_base=True), pose_accuracy(POINTS, moved(rows))
    assert value(base, "AP P2") > 1
    assert value(fitted, "AP P2") < 0.02
    assert "leave out" in fitted.notes[0]
    assert fitted.frame == "fitted"
    for name in ("RP P1", "RP P5", "AD", "RD"):
        assert value(fitted, name) == pytest.approx(value(base, name), rel=1e-9)
    bent = pose_accuracy(POINTS, moved(visited(5, off={"P3": (0, 0, 1.0)})))
    assert value(bent, "AP P3") > 0.3, "what is no rigid motion stays"


def test_pose_accuracy_falls_to_what_compensation_leaves(plan, ur5, truth):
    def seen(joints):
        poses = predict(truth, joints).poses
        tips = poses[:, :3, 3] + poses[:, :3, :3] @ plan.tool
        return visited(1, points=dict(zip(plan.names, tips, strict=True)), std=0.01)

    corrected = compensate(truth, plan.joints)
    before, after = (pose_accuracy(plan, seen(joints), in_base=True) for joints in (plan.joints, corrected.joints))
    bound = corrected.residual_mm.max() + 0.2 * corrected.residual_rad.max() + 4 * 0.01 * math.sqrt(3 / 30)
    for name, now, then, ratio in after.table(before):
        if name.startswith("AP P"):
            assert then.value > 0.5
            assert now.value < bound
            assert ratio == pytest.approx(now.value / then.value)
        if name.startswith("RP"):
            assert now.value == pytest.approx(0.01 * 3.615, rel=0.35)
    assert abs(value(after, "AD")) < 0.02 < abs(value(before, "AD"))


def test_the_error_of_a_fitted_accuracy_is_what_the_same_test_scatters_by():
    """Cycles that drift together are drawn along by the fitted frame; points that scatter each by itself are not."""

    def drifting(seed, drift, std):
        rows = visited(seed, 12, std)
        together = np.random.default_rng((seed, 1)).normal(0, drift, (12, 3))[rows["cycle"].to_numpy() - 1]
        return rows.assign(
            **dict(zip(("x_mm", "y_mm", "z_mm"), (rows.iloc[:, 2:].to_numpy() + together).T, strict=True))
        )

    names = ("APx P1", "APy P3", "APz P5")
    for drift, std in ((0.2, 0.02), (0.0, 0.1)):
        found = [pose_accuracy(POINTS, drifting(seed, drift, std)).criteria for seed in range(60)]
        for name in names:
            scatter = np.std([each[name].value for each in found])
            said = math.sqrt(np.mean([each[name].std ** 2 for each in found]))
            assert said == pytest.approx(scatter, rel=0.35)


def test_points_of_ones_own_may_begin_with_any_letter():
    """L followed by a number is a place of the path, as `plan_cube` names them."""
    own = dict(zip(("A", "B", "LEFT", "D", "E"), POINTS.values(), strict=True))
    found = pose_accuracy(own, visited(3, points=own, names=[*own]), in_base=True)
    assert {"AP LEFT", "RP LEFT"} <= set(found.criteria)


def test_the_path_is_judged_in_its_normal_planes():
    """A lag along the line counts for nothing, and what bows away from it in full."""
    line = {f"L{k}": np.array([800, -200, 300]) + np.array([-400, 400, 400]) * (k - 1) / 10 for k in range(13)}
    points = POINTS | line
    across = np.array([1, 1, 0]) / ROOT2
    along = np.array([-1, 1, 1]) / math.sqrt(3)
    off = {name: 0.5 * along + (0.4 * across if name == "L6" else 0) for name in line}
    rows = pd.concat([visited(1, std=0.0), visited(2, 10, 0.0, off, points, [*line])])
    found = pose_accuracy(points, rows, in_base=True)
    spacing = 40 * math.sqrt(3)
    assert value(found, "AT") == pytest.approx(0.4 * (1 - 0.5 / spacing), rel=1e-9)
    assert value(found, "RT") == pytest.approx(0, abs=1e-9)
    assert found.criteria["AT"].cycles == 10
    scattered = pd.concat([visited(1), visited(2, 40, 0.02, {}, points, [*line])])
    found = pose_accuracy(points, moved(scattered))
    in_plane = 0.02 * (math.sqrt(math.pi / 2) + 3 * math.sqrt(2 - math.pi / 2))
    assert in_plane < value(found, "RT") < 1.6 * in_plane
    holed = scattered[(scattered["point"] != "L6") | (scattered["cycle"] > 5)]
    assert pose_accuracy(points, holed, in_base=True).criteria["AT"].cycles == 35
    mixed = pose_accuracy(points, scattered.sample(frac=1, random_state=1), in_base=True)
    assert value(mixed, "AT") == pytest.approx(value(pose_accuracy(points, scattered, in_base=True), "AT"), rel=1e-9)
    dense = scattered.assign(point=scattered["point"].where(scattered["point"].str.startswith("P"), "L"))
    assert value(pose_accuracy(points, dense, in_base=True), "AT") < 0.02


def test_orientations(plan, tmp_path):
    from scipy.spatial.transform import Rotation

    rng, rows = np.random.default_rng(0), visited(1, points=dict(zip(plan.names, plan.tips, strict=True)))
    turn = Rotation.from_matrix(plan.poses[0, :3, :3])
    off = np.radians(rng.normal((0.2, 0, 0), 0.01, (len(rows), 3)))
    rows[["qx", "qy", "qz", "qw"]] = (Rotation.from_rotvec(off) * turn).as_quat()
    (tmp_path / "plan.csv").write_text(plan.text())
    for targets in (plan, tmp_path / "plan.csv"):
        found = pose_accuracy(targets, rows, in_base=True)
        assert value(found, "APa P1") == pytest.approx(0.2, abs=0.01)
        assert value(found, "APb P1") == pytest.approx(0, abs=0.01)
    own = np.degrees(off[rows["point"] == "P1"])
    assert value(found, "RPc P1") == pytest.approx(3 * own[:, 2].std(ddof=1), rel=1e-3)
    assert found.criteria["RPc P1"].unit == "deg"
    rows[["qx", "qy", "qz", "qw"]] = (Rotation.from_rotvec(off) * turn * Rotation.from_rotvec([1, 0, 0])).as_quat()
    found = pose_accuracy(plan, rows, in_base=True)
    assert "APa P1" not in found.criteria
    assert "axes are not the flange's" in found.notes[0]
    assert value(found, "RPc P1") == pytest.approx(3 * own[:, 2].std(ddof=1), rel=1e-3)


def test_orientations_are_about_the_axes_of_the_base(plan):
    from scipy.spatial.transform import Rotation

    rng, rows = np.random.default_rng(0), visited(1, points=dict(zip(plan.names, plan.tips, strict=True)))
    off = Rotation.from_rotvec(np.radians(rng.normal(0, (0.05, 0.01, 0.01), (len(rows), 3))))
    turned = Rotation.from_euler("z", 90, degrees=True)
    rows[["qx", "qy", "qz", "qw"]] = (turned * off * Rotation.from_matrix(plan.poses[0, :3, :3])).as_quat()
    rows[["x_mm", "y_mm", "z_mm"]] = rows[["x_mm", "y_mm", "z_mm"]].to_numpy() @ turned.as_matrix().T
    found = pose_accuracy(plan, rows)
    assert value(found, "RPa P1") > 3 * value(found, "RPb P1")
    assert "APa P1" not in found.criteria


def test_there_is_no_ratio_to_what_is_nothing_but_scatter():
    before, after = (pose_accuracy(POINTS, visited(seed, off={"P1": (0, 0, 1)}), in_base=True) for seed in (1, 2))
    ratios = {name: ratio for name, _, _, ratio in after.table(before)}
    assert ratios["AP P1"] == pytest.approx(1, abs=0.02)
    small = {name for name, each in before.criteria.items() if abs(each.value) < 2 * each.std}
    assert small
    assert all(ratios[name] is None for name in small)


def test_a_dial_tells_of_its_axis_alone():
    rows = visited(2).assign(reading_um=lambda each: 1000 * (each["x_mm"] - each["x_mm"].round(-1)))
    found = pose_accuracy(POINTS, rows[["cycle", "point", "reading_um"]])
    assert set(found.criteria) == {f"3s P{k}" for k in range(1, 6)}
    assert value(found, "3s P4") == pytest.approx(3 * at(rows, "P4")[:, 0].std(ddof=1), rel=1e-9)
    assert found.frame == "none"
    assert "cannot be told" in found.notes[0]


def test_lines_that_were_left_empty_are_counted():
    rows = visited(1)
    whole = pose_accuracy(POINTS, rows, in_base=True)
    rows.loc[[7, 8, 40], ["x_mm", "y_mm", "z_mm"]] = np.nan
    found = pose_accuracy(POINTS, rows, in_base=True)
    assert found.missing == 3
    assert found.notes[0] == "3 lines without a measurement"
    assert found.criteria["AP P3"].cycles == 29
    assert found.criteria["AD"].cycles == 29
    unnamed = rows.drop(columns=["cycle", "point"])
    assert value(pose_accuracy(POINTS, unnamed, in_base=True), "RD") == pytest.approx(value(found, "RD"), rel=1e-12)
    gone = rows.drop(index=[7, 8, 40]).drop(columns="cycle")
    assert value(pose_accuracy(POINTS, gone, in_base=True), "RD") == pytest.approx(value(found, "RD"), rel=1e-12)
    assert value(whole, "RD") != value(found, "RD")


def test_rows_whose_cycles_nobody_knows_tell_no_distance():
    rows = visited(1).sort_values(["point", "cycle"]).drop(columns="cycle")
    found = pose_accuracy(POINTS, rows, in_base=True)
    assert "AD" not in found.criteria
    assert "add a column 'cycle'" in found.notes[0]
    assert value(found, "RP P2") == pytest.approx(value(pose_accuracy(POINTS, visited(1), in_base=True), "RP P2"))
    shuffled = visited(1).sample(frac=1, random_state=3)
    assert value(pose_accuracy(POINTS, shuffled, in_base=True), "RD") == pytest.approx(
        value(pose_accuracy(POINTS, visited(1), in_base=True), "RD"), rel=1e-12
    )


def test_a_point_that_was_never_measured_and_two_that_fix_no_frame():
    rows = visited(1)
    found = pose_accuracy(POINTS, moved(rows[rows["point"] != "P3"]))
    assert "P3: fewer than two" in found.notes[0]
    assert "AP P3" not in found.criteria
    assert "AP P4" in found.criteria
    found = pose_accuracy(POINTS, moved(rows[rows["point"].isin(["P2", "P4"])]))
    assert {name[:2] for name in found.criteria} == {"RP", "AD", "RD"}
    assert "Fewer than three points" in found.notes[1]


def in_metres(rows):
    return rows.assign(**{name: rows[name] / 1000 for name in ("x_mm", "y_mm", "z_mm")})


def renamed(rows):
    return rows.assign(point=rows["point"].replace({"P2": "P4", "P4": "P3", "P3": "P2"}))


def with_row(rows, k, **values):
    rows = rows.copy()
    for name, each in values.items():
        rows.loc[k, name] = each
    return rows


@pytest.mark.parametrize(
    ("slip", "said"),
    [
        (in_metres, "seem to be in m, and are read in mm"),
        (lambda rows: rows.drop(columns="y_mm"), "no column for y"),
        (lambda rows: rows.rename(columns={"y_mm": "y"}), "no unit"),
        (lambda rows: rows[rows["cycle"] == 1], "no point was measured in two cycles"),
        (renamed, "under other names"),
        (lambda rows: moved(visited(1, points={k: np.array(p) * 1.3 for k, p in POINTS.items()})), "another cube"),
        (lambda rows: with_row(rows, 11, x_mm=0.0), "line 12: P4 lies"),
        (lambda rows: with_row(rows, 11, point="P7"), "line 12: 'P7' is no commanded point"),
        (lambda rows: with_row(rows, 11, cycle=2), "line 12: P4 was measured in cycle '2' before"),
        (lambda rows: rows.drop(columns=["point", "cycle"]).iloc[:-1], "no whole cycles"),
        (lambda rows: rows.drop(columns=["point", "cycle"]).iloc[::-1], "another order"),
        (lambda rows: rows.assign(x_mm="", y_mm="", z_mm=""), "every line is empty"),
        (lambda rows: with_row(rows.astype({"x_mm": object}), 3, x_mm="lost"), "not a finite number"),
        (lambda rows: rows.assign(qw=2.0, qx=0.0, qy=0.0, qz=0.0), "not of unit length"),
    ],
)
def test_slips_end_in_sentences(slip, said):
    rows = visited(1)
    if "cycle '2'" in said:  # row 11 is P4 of cycle 3
        assert rows.loc[11, "point"] == "P4"
    with pytest.raises(SamplesError, match=said):
        pose_accuracy(POINTS, slip(rows))


def test_a_frame_that_is_not_the_base_is_not_taken_for_it():
    with pytest.raises(SamplesError, match="not in the base frame"):
        pose_accuracy(POINTS, moved(visited(1)), in_base=True)
    two = moved(visited(1, points={k: np.array(p) * 1.3 for k, p in POINTS.items()}, names=["P4", "P2"]))
    with pytest.raises(SamplesError, match="another cube"):
        pose_accuracy(POINTS, two)


def test_cubes_out_of_reach_and_slips_of_a_plan(ur5):
    with pytest.raises(CasacalError, match="reaches"):
        plan_cube(ur5.problem, centre=(450, 0, 350), side=1500)
    with pytest.raises(CasacalError, match="not even its centre"):
        plan_cube(ur5.problem, centre=(3000, 0, 350), side=300)
    cube = {"centre": (-450, 0, 350), "side": 300}
    box = (-700, -500), (-300, -50), (150, 550)
    with pytest.raises(CasacalError, match="up to a side of"):
        plan_cube(ur5.problem, **cube, clearance=Clearance((box,)))
    with pytest.raises(CasacalError, match="reaches"):
        plan_cube(ur5.problem, centre=(-450, 0, 100), side=300)
    below = plan_cube(ur5.problem, centre=(-450, 0, 100), side=300, cell=Disturbances(table=-500))
    assert below.tips[:, 2].min() < 0
    for slip, said in (
        ({"centre": (450, 0, 350)}, "both"),
        ({"centre": (0.45, 0, 0.35), "side": 0.3}, "0.4 m are 400"),
        ({"centre": (450, 0), "side": 300}, "three numbers"),
        ({"plane": "z+"}, "no plane named"),
        ({"tool": (1, 2)}, "measured point"),
        ({"tool": (0, 0, 0.15)}, "0.15 m are 150"),
    ):
        with pytest.raises(CasacalError, match=said):
            plan_cube(ur5.problem, **slip)
    with pytest.raises(CasacalError, match="no orientation can be asked"):
        plan_cube(load_problem(ROOT / "problems" / "adept_cobra600").problem)


def test_the_command_plans_and_judges(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    cube = ["--centre", "-450,0,350", "--side", "300", "--plane", "x+", "--tool", "0,0,150"]
    assert main(["iso9283", str(ROOT / "problems" / "ur5"), "--out", "plan.csv", "--sheet", "sheet.csv", *cube]) == 0
    assert "0, 0, 150 mm in the flange frame" in capsys.readouterr().out
    sheet = pd.read_csv("sheet.csv", comment="#")
    assert len(sheet) == 30 * 5 + 10 * 13
    assert list(sheet["point"][:5]) == ORDER
    plan = pd.read_csv("plan.csv", comment="#").set_index("point")
    points = dict(zip(plan.index, plan[["tip_x_mm", "tip_y_mm", "tip_z_mm"]].to_numpy(), strict=True))
    flange = plan.loc["P1", ["flange_x_mm", "flange_y_mm", "flange_z_mm"]].to_numpy(float)
    assert points["P1"] - flange == pytest.approx([-150 / ROOT2, 0, -150 / ROOT2], abs=0.01)
    visited(1, points=points, off={"P1": (0, 0, 0.1)}).to_csv("after.csv", index=False)
    visited(2, points=points, off={"P1": (0, 0, 1)}).to_csv("before.csv", index=False)
    words = ["iso9283", "plan.csv", "after.csv", "--before", "before.csv", "--in-base"]
    assert main([*words, "--out", "figures.csv"]) == 0
    shown = capsys.readouterr().out
    assert "AP P1" in shown
    assert "ratio" in shown
    rows = pd.read_csv("figures.csv", comment="#").set_index("figure")
    assert rows.loc["AP P1", "ratio"] == pytest.approx(0.1, abs=0.01)
    assert rows.loc["AP P1", "cycles"] == 30
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["criteria"]["AP P1"]["value"] == pytest.approx(rows.loc["AP P1", "value"], abs=1e-6)
    assert told["before"]["frame"] == "base"
    sheet.to_csv("sheet.csv", index=False)
    for wrong, said in (
        (["iso9283", "plan.csv", "sheet.csv"], "every line is empty"),
        (["iso9283", "plan.csv", "plan.csv"], "these are targets"),
        (["iso9283", "after.csv", "plan.csv"], "these are not the targets"),
        (["iso9283", str(ROOT / "problems" / "ur5"), "after.csv"], "holds no targets"),
        (["iso9283", "plan.csv", "after.csv", "--side", "300"], "--side is for planning"),
        (["iso9283", str(ROOT / "problems" / "ur5"), "--out", "a.csv", "--in-base"], "--in-base is for measured rows"),
        (["iso9283", str(ROOT / "problems" / "ur5")], "--out is missing"),
        (["iso9283", "plan.csv", "--out", "a.csv"], "casacal"),
        (["iso9283", "plan.csv", "after.csv", "--out", "after.csv"], "what the command reads"),
        (["iso9283", str(ROOT / "problems" / "ur5"), "--out", "a.csv", "--centre", "1,2", "--side", "300"], "X,Y,Z"),
    ):
        assert main(wrong) == 2, wrong
        assert said in capsys.readouterr().err, wrong


def test_points_of_ones_own(tmp_path):
    """As for a SCARA: any names, in a CSV without joints."""
    own = {"A": (300, 0, 50), "B": (300, 200, 50), "C": (100, 250, 50)}
    lines = [f"{name},{x},{y},{z}" for name, (x, y, z) in own.items()]
    (tmp_path / "own.csv").write_text("\n".join(["point,x_mm,y_mm,z_mm", *lines]))
    rows = visited(1, points=own, names=["A", "B", "C"], off={"B": (0, 0, 0.5)})
    found = pose_accuracy(tmp_path / "own.csv", rows, in_base=True)
    assert value(found, "AP B") == pytest.approx(0.5, abs=0.02)
    assert value(found, "RP C") == pytest.approx(0.02 * 3.615, rel=0.35)
    assert "AD and RD cannot be told" in found.notes[0]
    (tmp_path / "own.csv").write_text("\n".join(["point,x_mm,y_mm,z_mm", *lines, lines[0]]))
    with pytest.raises(SamplesError, match="line 5: 'A' is listed twice"):
        pose_accuracy(tmp_path / "own.csv", rows)
