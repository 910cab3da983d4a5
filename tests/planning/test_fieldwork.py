"""What plans keep clear of, and what they become: programs read back, sheets parsed, set-ups compared."""

import itertools
import json
import re
from dataclasses import replace

import html5lib
import numpy as np
import pytest
from conftest import ROOT
from scipy.optimize import minimize

from casacal import Cell, Face, Problem, TrackedPoint, bind, load_problem, plan, simulate
from casacal.cli.main import main
from casacal.errors import CasacalError
from casacal.fit.nominal import nominal_tips
from casacal.model.capsules import Skeleton, Solid, between, radii_of, to_box
from casacal.model.robot import random_joints
from casacal.planning.cell_drawing import CellDrawing
from casacal.planning.choice import Choice
from casacal.planning.clearance import Clearance
from casacal.planning.handouts import approaches, program_text, sheet_page
from casacal.planning.plan import touches_for
from casacal.planning.set_ups import set_ups
from casacal.uncertainty.tip_error import planned_accuracy

NAMES = ("hsr_jr680", "ur5", "kuka_iiwa14", "adept_cobra600")
HSR, IIWA = (ROOT / "problems" / name for name in ("hsr_jr680", "kuka_iiwa14"))


@pytest.fixture(scope="module")
def small(hsr):
    return plan(hsr.problem, hsr.cell, touches=30, pool=300, starts=1, seed=2)


@pytest.mark.parametrize("name", NAMES)
def test_nodes_are_carried_by_the_joints_before_them(name):
    """Turning a joint leaves all nodes up to its own place where they are; the last one is the flange."""
    source = load_problem(ROOT / "problems" / name)
    robot = source.problem.robot
    joints = random_joints(robot, 5, np.random.default_rng(1))
    nodes = Skeleton.of(robot).place(joints)
    assert nodes.shape == (5, joints.shape[1] + 2, 3)
    for j in range(joints.shape[1]):
        moved = joints.copy()
        moved[:, j] += 0.1 if robot.revolute[j] else 20.0
        others = Skeleton.of(robot).place(moved)
        still = j + 1 if robot.revolute[j] else j  # a place on a turning axis stays where it is
        assert others[:, :still] == pytest.approx(nodes[:, :still], abs=1e-9)
        assert not np.allclose(others[:, -1], nodes[:, -1]) or j == joints.shape[1] - 1


def test_flange_is_the_last_node(hsr):
    problem = Problem(hsr.problem.robot, TrackedPoint(noise_std=0.01))
    made = simulate(problem, samples=8, seed=1)
    bound = bind(problem, made.samples)
    flange = bound.tips(bound.x0, made.samples.joints)
    assert Skeleton.of(problem.robot).place(made.samples.joints)[:, -1] == pytest.approx(flange, abs=1e-6)


def test_boxes_are_kept_out_of(hsr, small):
    """By brute force: a thousand points on every rod."""
    robot, joints = hsr.problem.robot, small.samples.joints
    nodes = Skeleton.of(robot).place(joints)
    tips = nodes[:, -1] + [0.0, 0.0, -5.0]
    low, high = nodes[0, 4] + [[-60.0], [60.0]]  # about the wrist of the first
    box = tuple(zip(low.tolist(), high.tolist(), strict=True))
    rods = np.concatenate([nodes, tips[:, None]], axis=1)
    part = np.linspace(0, 1, 1000)[:, None]
    points = (rods[:, :-1, None] * (1 - part) + rods[:, 1:, None] * part).reshape(len(joints), -1, 3)
    away = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=2).min(axis=1)
    found = np.all([~rows for _, other, rows in Clearance((box,), 60.0).around(robot, None).collisions(joints, tips)
                    if other == "box 1"], axis=0)  # fmt: skip
    thick = np.repeat([60.0] * 5 + [30.0] * 3, 1000)  # the last two links and the tool are half as thick
    away = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0), axis=2)[:, 1000:] - thick[1000:]
    np.testing.assert_array_equal(found, away.min(axis=1) > 0)
    assert 0 < found.sum() < len(found)
    ends = ((nodes[:, -1] >= low) & (nodes[:, -1] <= high)).all(axis=1)
    assert (Clearance((box,), 0).around(robot, None).clear(joints, tips) == ~ends).all(), "flange and tip alone"


def least(one, two):
    """The least distance of two convex bodies, each a function of parameters in 0 to 1, by SciPy."""
    count = len(one(None)), len(two(None))

    def away(x):
        return float(np.sum((one(x[: count[0]]) - two(x[count[0] :])) ** 2))

    starts = np.random.default_rng(0).uniform(0, 1, size=(3, sum(count)))
    found = min(
        minimize(away, x, bounds=[(0, 1)] * sum(count), options={"ftol": 1e-16, "gtol": 1e-10}).fun for x in starts
    )
    return np.sqrt(found)


def segment(start, end):
    return lambda x: np.zeros(1) if x is None else start + x[0] * (end - start)


def test_distances_of_segments_and_boxes_are_those_that_a_search_finds():
    rng = np.random.default_rng(3)
    ends = rng.uniform(-300, 300, size=(4, 60, 3))
    ends[1, :8] = ends[0, :8]  # of no length
    ends[3, 8:16] = ends[2, 8:16] + 1.7 * (ends[1, 8:16] - ends[0, 8:16])  # parallel
    ends[2, 16:24] = ends[0, 16:24] + 0.3 * (ends[1, 16:24] - ends[0, 16:24])  # touching
    ends[1, 24:32, :2] = ends[0, 24:32, :2]  # along an axis
    low, high = np.array([-20.0, -150.0, -60.0]), np.array([0.0, 150.0, 60.0])

    def box(x):
        return np.zeros(3) if x is None else low + x * (high - low)

    apart, off = between(*ends), to_box(ends[0], ends[1], low, high)
    for k in range(60):
        a, b, c, d = ends[:, k]
        assert apart[k] == pytest.approx(least(segment(a, b), segment(c, d)), abs=2e-3)
        assert off[k] == pytest.approx(least(segment(a, b), box), abs=2e-3)
    assert (off == 0).any()


def test_a_thin_rod_does_not_slip_through_a_thin_plate(hsr):
    """A tool that pierces the second face, and one that ends on it."""
    robot, joints = hsr.problem.robot, np.zeros((2, 6))
    flange = Skeleton.of(robot).place(joints)[:, -1]
    tips = np.add(flange, ((0.0, 0.0, -300.0), (0.0, 0.0, -120.0)))
    cell = Cell(faces=(Face("thin", tuple(tips[1]), (0.0, 0.0, 1.0), (0.5, 0.5)),))
    assert Clearance().around(robot, cell).clear(joints, tips).tolist() == [False, True]
    found = Clearance().around(robot, cell).collisions(joints, tips)
    assert [(part, other) for part, other, rows in found if rows.any()] == [("the tool", "face 'thin'")]


def test_nothing_that_is_near_is_passed_over():
    """Links against a box and against one another, by the distances of many points along each."""
    robot = load_problem(ROOT / "problems" / "ur5").problem.robot
    skeleton, rng = Skeleton.of(robot), np.random.default_rng(2)
    joints = random_joints(robot, 150, rng)
    places = skeleton.place(joints)
    tips = places[:, -1] + rng.normal(size=(150, 3)) * 40
    nodes = np.concatenate([places, tips[:, None]], axis=1)
    box = ((250.0, 500.0), (-200.0, 150.0), (100.0, 420.0))
    low, high = np.array(box).T
    part = np.linspace(0, 1, 80)[:, None]
    along = [nodes[:, k, None] + part * (nodes[:, k + 1] - nodes[:, k])[:, None] for k in range(nodes.shape[1] - 1)]
    radii = dict(zip(["the base", *(f"link {k}" for k in range(1, 7)), "the tool"], radii_of(60.0, 8), strict=True))
    names, hits = list(radii), 0
    solids = [Solid.box("box", box)]
    for name, other, rows in skeleton.collisions(joints, tips, 60.0, table=-1e4, solids=solids):
        if other == "the table":
            continue
        one = along[names.index(name)]
        if other == "box":
            apart = np.linalg.norm(one - one.clip(low, high), axis=2).min(axis=1)
            least = radii[name]
            free = np.ones(150, dtype=bool)
        else:
            two, lengths = along[names.index(other)], np.linalg.norm(np.diff(nodes, axis=1), axis=2)
            apart = np.linalg.norm(one[:, :, None] - two[:, None], axis=3).min(axis=(1, 2))
            least = radii[name] + radii[other]
            free = lengths[:, names.index(name) + 1 : names.index(other)].sum(axis=1) > 120.0
        told = np.abs(apart - least) > 6.0  # further than the points are apart
        assert (rows == ((apart < least) & free))[told].all(), (name, other)
        hits += int(rows.sum())
    assert hits > 100


def test_a_plan_keeps_clear(hsr):
    box = ((-3000.0, 3000.0), (-3000.0, 3000.0), (700.0, 900.0))
    free = plan(hsr.problem, hsr.cell, touches=20, pool=300, starts=1)
    kept = plan(hsr.problem, hsr.cell, touches=20, pool=300, starts=1, clearance=Clearance((box,), 0))
    heights = [Skeleton.of(hsr.problem.robot).place(each.samples.joints)[:, -1, 2] for each in (free, kept)]
    assert ((heights[0] > 700) & (heights[0] < 900)).any()
    assert not ((heights[1] > 700) & (heights[1] < 900)).any()
    assert len(kept) == 20
    everywhere = ((-5000.0, 5000.0),) * 3
    with pytest.raises(
        CasacalError, match=r"Only 0 of \d+ reachable .* table at z = 0 mm. In the way: link 1 against box 1 \(100%\)"
    ):
        plan(hsr.problem, hsr.cell, touches=20, pool=300, clearance=Clearance((everywhere,)))
    for wrong in ({"boxes": (((0, 1), (0, 1)),)}, {"boxes": (((1, 0), (0, 1), (0, 1)),)}, {"link_radius": -1.0}):
        with pytest.raises(CasacalError):
            Clearance(**wrong)


def test_arms_keep_off_themselves():
    """The forearm of a UR5 folded back onto its upper arm, and stretched out."""
    robot = load_problem(ROOT / "problems" / "ur5").problem.robot
    folded, stretched = np.zeros(6), np.zeros(6)
    folded[2] = np.pi * 0.98
    joints = np.array([folded, stretched])
    tips = Skeleton.of(robot).place(joints)[:, -1]
    assert Clearance((), 45.0).around(robot, None).clear(joints, tips).tolist() == [False, True]


def test_determinants_are_made_small():
    """Of 11 measurements 4, all 330 ways."""
    rng = np.random.default_rng(5)
    rows, known = rng.normal(size=(11, 2, 6)), np.diag(rng.uniform(0.1, 1, 6))

    def volume(chosen):
        return -np.linalg.slogdet(known + sum(rows[k].T @ rows[k] for k in chosen))[1]

    best = min(volume(chosen) for chosen in itertools.combinations(range(11), 4))
    starts = (rng.choice(11, 4, replace=False) for _ in range(6))
    found = [Choice(rows, known, np.eye(6)).exchange(start, criterion="parameters") for start in starts]
    assert min(loss for _, loss in found) == pytest.approx(best, abs=1e-9)
    assert all(loss == pytest.approx(volume(chosen), abs=1e-9) for chosen, loss in found)


def test_what_is_chosen_for_the_tip_is_better_there_and_worse_for_the_parameters(hsr):
    both = [
        plan(hsr.problem, hsr.cell, touches=30, pool=300, check=0, again=0, criterion=name)
        for name in ("tip", "parameters")
    ]
    volumes = []
    for each in both:
        bound = bind(hsr.problem, each.samples)
        units = bound.start_std
        information = units[:, None] * (bound.information(bound.x0) + bound.prior_information) * units
        volumes.append(-np.linalg.slogdet(information)[1])
    assert both[0].error < both[1].error
    assert volumes[1] < volumes[0]
    with pytest.raises(CasacalError, match="criterion"):
        plan(hsr.problem, hsr.cell, touches=30, pool=300, criterion="volume")


def test_touches_that_were_made_count(hsr):
    """After eighty touches ten more bring less than the first ten did, and the figure is that of all ninety."""
    made = simulate(hsr.problem, hsr.cell, samples=80, seed=3).samples
    more = plan(hsr.problem, hsr.cell, touches=10, pool=300, check=0, again=0, after=made)
    alone = plan(hsr.problem, hsr.cell, touches=10, pool=300, check=0, again=0)
    assert more.error < more.before < 0.5 * alone.error
    assert more.before == pytest.approx(planned_accuracy(bind(hsr.problem, made))[1], rel=0.03)
    assert more.before - more.error < 0.5 * (alone.before - alone.error)
    with pytest.raises(CasacalError, match="as touches that were made"):
        plan(hsr.problem, hsr.cell, touches=10, pool=300, after="samples.csv")


@pytest.mark.long
def test_a_new_motor_takes_few_touches(hsr):
    """The zero of joint 4 may be off by half a degree: what that costs, and the fewest touches that restore it."""
    made = simulate(hsr.problem, hsr.cell, samples=120, seed=3).samples
    usual = {"check": 0.0, "again": 0.0, "pool": 300, "after": made}
    intact = plan(hsr.problem, hsr.cell, touches=4, **usual)
    lost = plan(hsr.problem, hsr.cell, touches=4, loose={"theta4": 0.01}, **usual)
    assert lost.before > 1.5 * intact.before
    assert lost.error < 1.1 * intact.before
    few = touches_for(hsr.problem, hsr.cell, 1.1 * intact.before, after=made, loose={"theta4": 0.01})
    assert 3 <= few <= 6
    with pytest.raises(CasacalError, match="'theta9'"):
        plan(hsr.problem, hsr.cell, touches=4, loose={"theta9": 0.01}, **usual)


def test_what_drawing_and_losses_cost(small):
    assert small.over_arms == pytest.approx(small.error, rel=0.05)
    assert small.error < small.if_lost < 1.6 * small.error


@pytest.mark.long
def test_set_ups_are_compared(hsr):
    found = set_ups(hsr.problem, hsr.cell, touches=30)
    words = [each.words for each in found]
    errors = [each.error for each in found]
    assert errors == sorted(errors)
    assert "gauge block of 100 mm" in words[0], "a known length is what planes lack"
    assert words[-1].startswith("one plate")
    here = next(each for each in found if each.words.startswith("as it is: 3 faces"))
    chosen = plan(here.problem, here.cell, touches=30, pool=600, starts=1, check=0, again=0)
    assert here.error == pytest.approx(chosen.error, rel=0.1)
    far = replace(hsr.cell, faces=(Face("far", (9000.0, 0.0, 0.0), (0.0, 0.0, 1.0)),))
    out_of_reach = set_ups(hsr.problem, far, touches=10)
    assert np.isinf(out_of_reach[-1].error)
    assert any(each.words == "three faces at right angles" for each in out_of_reach)
    with pytest.raises(CasacalError, match="touches no faces"):
        set_ups(Problem(hsr.problem.robot, TrackedPoint(noise_std=0.01)))


@pytest.mark.long
def test_ways_lead_above_the_touches(hsr, small):
    """The tip stands back by as much as is said, along the plunger; no way comes near a face, by another eye."""
    ways = approaches(hsr.problem, small, hsr.cell)
    bound = bind(hsr.problem, small.samples)
    reading = small.samples.columns["reading"]
    above = replace(small.samples, joints=ways.above)
    on_it = bound.on(small.samples).plain_residual(bound.x0)
    off_it = bound.on(above).plain_residual(bound.x0)
    assert np.abs(on_it).max() < 1e-4
    assert (off_it > 0).all(), "on the side of the tool"
    heights = off_it
    assert (heights <= ways.retreat + 0.1).all()
    assert (heights >= ways.retreat * np.cos(hsr.cell.tilt) - 0.1).all()
    assert set(np.unique(ways.retreat)) <= {20.0, 40.0, 80.0, 160.0}
    faces = {face.label: face for face in hsr.cell.faces}
    for k in range(1, len(small)):
        part, stops = np.linspace(0, 1, 60)[:, None], [ways.above[k - 1], ways.via[k], ways.above[k]]
        legs = itertools.pairwise([stop for stop in stops if np.isfinite(stop).all()])
        way = np.vstack([start * (1 - part) + end * part for start, end in legs])
        tips = bound.tips(bound.x0, way)
        for face in faces.values():
            local = (tips - face.centre) @ face.axes.T
            over = (np.abs(local[:, 1:]) <= np.array(face.size) / 2).all(axis=1)
            assert not ways.clear[k] or (local[over, 0] > 0.5).all() or (local[over, 0] < 0).all()
    assert ways.clear.mean() > 0.8
    tips = bound.tips(bound.x0, ways.above)
    corners = np.zeros(len(small), dtype=bool)
    for face in faces.values():  # near an edge a plunger drawn back is in the next face
        local = (tips - face.centre) @ face.axes.T
        corners |= (np.abs(local[:, 1:]) <= np.array(face.size) / 2 + 2).all(axis=1) & (local[:, 0] < 2)
    assert (corners | np.roll(corners, 1))[~ways.clear].all(), "nothing else keeps a touch from being reached"
    assert reading.min() > 0
    shut = Clearance((((-3000.0, 3000.0), (-3000.0, 3000.0), (-3000.0, 3000.0)),))
    assert not approaches(hsr.problem, small, hsr.cell, clearance=shut).clear[1:].any()
    with pytest.raises(CasacalError, match="no plunger"):
        approaches(Problem(hsr.problem.robot, TrackedPoint(noise_std=0.01)), small)


@pytest.mark.parametrize(("language", "pattern", "stop"), [
    ("rapid", r"MoveAbsJ \[\[([^]]+)\]", "Stop;"),
    ("krl", r"PTP \{([^}]+)\}", "HALT"),
    ("urscript", r"movej\(\[([^]]+)\]", "popup("),
])  # fmt: skip
def test_programs_hold_the_plan(hsr, small, language, pattern, stop):
    ways = approaches(hsr.problem, small, hsr.cell)
    text = program_text(hsr.problem, small, ways, language, "an arm\nMoveAbsJ [[0,0,0,0,0,0]]")
    found = [[float(re.sub(r"A\d", "", cell)) for cell in match.split(",")] for match in re.findall(pattern, text)]
    moves = np.array([each for each in found if any(each)])
    joints = moves if language == "urscript" else np.radians(moves)
    expected = []
    for k in range(len(small)):
        straight = [ways.above[k], small.samples.joints[k], ways.above[k]]
        expected += straight if np.isnan(ways.via[k]).any() else [ways.via[k], *straight]
    assert joints == pytest.approx(np.array(expected), abs=2e-6)
    assert text.count(stop) == 1 + len(small) + int((~ways.clear).sum()), "also before the first move"
    assert all(line.strip()[0] in "!;#" for line in text.splitlines() if "an arm" in line)
    blocked = program_text(hsr.problem, small, replace(ways, clear=ways.clear & False), language, "an arm")
    assert blocked.count("no clear way to touch") == len(small)
    assert text.isascii()


def test_programs_are_for_six_joints_that_turn(small):
    source = load_problem(IIWA)
    route = plan(source.problem, source.cell, touches=8, pool=60, starts=1)
    ways = approaches(source.problem, route, source.cell)
    with pytest.raises(CasacalError, match="has 7 joints"):
        program_text(source.problem, route, ways, "rapid", "arm")
    with pytest.raises(CasacalError, match="Did you mean 'krl'"):
        program_text(source.problem, small, ways, "krll", "arm")


def test_a_sheet_has_ten_touches_a_page(hsr):
    cell = Cell(faces=tuple(replace(face, label=f"<{face.label}> & co") for face in hsr.cell.faces))
    made = plan(hsr.problem, cell, touches=45, pool=300, starts=1)
    parser = html5lib.HTMLParser(strict=True, namespaceHTMLElements=False)
    tree = parser.parse(sheet_page(hsr.problem, made, "arm <1>", cell=made.cell))
    tables = tree.findall(".//table")
    assert [len(table.findall("./tbody/tr")) for table in tables] == [10, 10, 10, 10, 5]
    rows = tree.findall(".//tbody/tr")
    for k, row in enumerate(rows):
        cells = ["".join(cell.itertext()) for cell in row.findall("td")]
        assert cells[2] == made.samples.labels["plane"][k]
        assert [float(cell) for cell in cells[3:9]] == pytest.approx(np.degrees(made.samples.joints[k]), abs=1e-4)
        assert float(cells[9]) == pytest.approx(made.samples.columns["reading"][k], abs=0.006)
        assert cells[10] == ""
        assert sum(str(each.tag).endswith("svg") for each in row.iter()) == 2
        assert [each.get("href") for each in row.iter() if str(each.tag).endswith("use")] == ["#cell-0", "#cell-1"]
    assert sum(row.get("class") == "check" for row in rows) == made.purposes.count("check")
    assert "http" not in sheet_page(hsr.problem, made, "arm")


def test_a_drawing_is_to_scale(hsr, small):
    """From above: nodes, faces, tips and the width of rods by one scale; the plunger ends at the circle."""
    around = Clearance().around(hsr.problem.robot, hsr.cell)
    tips = nominal_tips(hsr.problem, 0, small.samples)
    drawing = CellDrawing.of(around, small.samples.joints, tips)
    side, top = (html5lib.parseFragment(view, namespaceHTMLElements=False)[0] for view in drawing.overview())
    parts = [each for each in top.iter() if str(each.tag).endswith("path") and "h" not in each.get("d")]
    lines = [np.array(re.findall(r"-?[\d.]+", each.get("d")), float).reshape(-1, 2) for each in parts]
    nodes = around.skeleton.place(small.samples.joints)[0]
    arm, wrist = len(hsr.cell.faces) + 1, len(hsr.cell.faces) + 2
    drawn = np.vstack([lines[arm], lines[wrist][1:]])
    seen = np.vstack([nodes[1:], tips[0]])[:, :2]
    scale = np.linalg.norm(drawn[-1] - drawn[0]) / np.linalg.norm(seen[-1] - seen[0])
    flipped = (drawn - drawn[0]) * [1, -1] / scale
    np.testing.assert_allclose(flipped, seen - seen[0], atol=0.2 / scale)
    assert float(parts[arm].get("stroke-width")) == pytest.approx(2 * around.radius * scale, abs=0.06)
    assert float(parts[wrist].get("stroke-width")) == pytest.approx(around.radius * scale, abs=0.06)
    floor = (lines[0] - drawn[0]) * [1, -1] / scale + seen[0]
    assert np.ptp(floor, axis=0) == pytest.approx([600, 600], abs=0.2 / scale)
    assert floor[:-1].mean(axis=0) == pytest.approx(hsr.cell.faces[0].centre[:2], abs=0.2 / scale)
    dots = [next(each.get("d") for each in view.iter() if each.get("stroke-width") == "7") for view in (side, top)]
    dots = [np.array(re.match(r"M(\S+) (\S+)h", each).groups(), float) for each in dots]
    assert dots[1] == pytest.approx(drawn[-1], abs=0.1)
    ground = next(each for each in side.iter() if str(each.tag).endswith("rect"))
    assert (float(ground.get("y")) - dots[0][1]) / scale == pytest.approx(tips[0, 2], abs=0.2 / scale)
    names = ["".join(each.itertext()) for each in top.iter() if str(each.tag).endswith("text")]
    assert names == ["floor", "wall", "side"]


@pytest.mark.long
@pytest.mark.usefixtures("set_ups_of_few")
def test_all_of_it_from_the_command_line(tmp_path, capsys):
    out = tmp_path / "plan.csv"
    usual = ["plan", str(HSR), "--touches", "20", "--pool", "200", "--out", str(out)]
    more = ["--sheet", str(tmp_path / "sheet.html"), "--program", "rapid", "--program", "krl", "--setups"]
    assert main([*usual, *more, "--keep-out", "5000:6000,0:1,0:1", "--link-radius", "30"]) == 0
    said = capsys.readouterr().out
    assert "a tenth of the touches lost" in said
    assert "gauge block" in said
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plan.csv", "plan.mod", "plan.src", "sheet.html"]
    assert main([*usual, "--json", "--setups"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["setups"][0]["expected_mm"] < document["tip_rms_mm"]["before"]
    samples = str(HSR / "samples.csv")
    again = ["--after", samples, "--loose", "theta4=0.01", "--touches", "4", "--check", "0", "--again", "0"]
    assert main(["plan", str(HSR), "--pool", "200", "--out", str(out), *again]) == 0
    assert "Without them:" in capsys.readouterr().out
    for wrong, words in (
        (["--loose", "theta4=0.01"], "without --after"),
        (["--after", samples, "--loose", "theta4=-1"], "is no standard deviation"),
        (["--after", samples, "--loose", "nothing=1"], "'nothing'"),
        (["--keep-out", "1:2"], "is not X0:X1"),
        (["--keep-out", "2:1,0:1,0:1"], "is empty"),
        (["--program", "basic"], "no language of programs named 'basic'"),
        (["--criterion", "x"], "no criterion named"),
        (["--retreat", "-3"], "--retreat is -3"),
        (["--sheet", str(out)], "the same name"),
    ):
        out.unlink(missing_ok=True)
        assert main([*usual, *wrong]) == 2, wrong
        assert words in capsys.readouterr().err
        assert not out.exists(), wrong


@pytest.mark.parametrize("radius", [40.0, 80.0])
def test_links_keep_off_faces_unless_it_is_the_tool_that_touches(hsr, radius):
    """A plate across the middle of each link in turn, and one a little further off than the link is thick."""
    robot, joints = hsr.problem.robot, np.array([[0.2, -0.3, 0.4, 0.1, 0.3, 0.0]])
    nodes = Skeleton.of(robot).place(joints)
    tips = nodes[:, -1] + [0.0, 0.0, -150.0]
    rods = np.concatenate([nodes, tips[:, None]], axis=1)[0]
    keep = Clearance((), radius)
    assert keep.around(robot, None).clear(joints, tips).all()
    long = [k for k in range(1, len(rods) - 3) if np.linalg.norm(rods[k + 1] - rods[k]) > 500]
    assert long
    for k in long:
        middle, along = (rods[k] + rods[k + 1]) / 2, rods[k + 1] - rods[k]
        across = np.cross(along, [0.3, 1.0, 0.2]) / np.linalg.norm(np.cross(along, [0.3, 1.0, 0.2]))
        for away, clear in ((0.5 * radius, False), (1.5 * radius, True)):
            face = Face("plate", middle - away * across, across, size=(120.0, 120.0))
            assert keep.around(robot, Cell(faces=(face,))).clear(joints, tips).tolist() == [clear], (k, away)
    at_tool = Face("plate", tips[0], (0.0, 0.0, 1.0), size=(20.0, 20.0))
    assert keep.around(robot, Cell(faces=(at_tool,))).clear(joints, tips).all()
