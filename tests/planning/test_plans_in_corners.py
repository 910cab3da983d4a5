"""Plans and sessions in corners: ways between raised ends, equalities, edited plans, boxes out of reach, set-ups."""

import json
from dataclasses import replace
from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from conftest import ROOT
from measured_world import World, taken

from casacal import CasacalError, Cell, DialOnPlane, Plane, Problem, load_problem, plan, plate, simulate
from casacal.cli.main import main
from casacal.planning.candidates import cell_of, pool_of
from casacal.planning.clearance import Clearance, drawn_touch
from casacal.planning.handouts import _is_clear, _StraightWays, approaches
from casacal.planning.plan import write_plan
from casacal.planning.route import Route, read_route, renumbered, shortest_way
from casacal.shopfloor import Session
from casacal.shopfloor.gauges import gauge
from casacal.shopfloor.known import Pool, covered
from casacal.shopfloor.recording import begun

HSR, UR5, THREE = (str(ROOT / "problems" / name) for name in ("hsr_jr680", "ur5", "ur5_three_instruments"))
PLAIN = gauge("plain")


def test_every_way_that_is_called_clear_is_clear():
    """A box stands among the touches: an end that is raised for its other way is looked at once more."""
    source = load_problem(UR5)
    clearance = Clearance((((340, 420), (-60, 60), (240, 330)),), 30.0)
    pool = pool_of(source.problem, source.cell, 200, 0, clearance)
    cell = cell_of(source.problem, source.cell)
    arm, *_ = drawn_touch(source.problem, source.problem.instrument.probe, pool)
    clear = partial(_is_clear, arm, cell, clearance.around(source.problem.robot, cell))
    some = np.random.default_rng(5).permutation(200)[:22]
    route = Route(pool.take(some[shortest_way(source.problem.robot, pool.joints[some])]), ("fit",) * 22)
    way = approaches(source.problem, route, source.cell, clearance=clearance, retreat=20)
    straight = [
        (before, after)
        for before, after in pairwise(np.flatnonzero(~np.isnan(way.retreat)))
        if way.clear[after] and np.isnan(way.via[after]).any()
    ]
    assert len(straight) > 10
    assert all(clear(way.above[before], way.above[after]) for before, after in straight)


def tool_of_ur5(joints):
    """Places (N, 121, 3; mm) along the tool, 120 mm from flange to tip, by the maker's DH table, row after row."""
    pose = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
    table = ((90, 0, 89.159), (0, -425, 0), (0, -392.25, 0), (90, 0, 109.15), (-90, 0, 94.65), (0, 0, 82.3))
    for (alpha, a, d), turn in zip(table, joints.T, strict=True):
        c, s, ca, sa = np.cos(turn), np.sin(turn), np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
        zero, one = np.zeros_like(c), np.ones_like(c)
        rows = ((c, -s * ca, s * sa, a * c), (s, c * ca, -c * sa, a * s), (zero, sa * one, ca * one, d * one))
        pose = pose @ np.moveaxis(np.array([*rows, (zero, zero, zero, one)]), 2, 0)
    return pose[:, None, :3, 3] + np.linspace(0, 120, 121)[None, :, None] * pose[:, None, :3, 2]


def inside(points, face, thick):
    """How deep (mm) places lie in a box behind a face, so thick; negative outside."""
    local = (points - np.array(face.centre)) @ face.axes.T
    sides = np.array(face.size) / 2 - np.abs(local[..., 1:])
    return np.concatenate([sides, -local[..., :1], local[..., :1] + thick], axis=-1).min(axis=-1)


def test_no_touch_stands_in_a_block_that_is_solid_down_to_its_plate():
    source = load_problem(UR5)
    pool = pool_of(source.problem, source.cell, 3000, 0)
    on_floor = np.array([label == "floor" for label in pool.labels["plane"]])
    block = source.cell.face("block")
    assert on_floor.sum() > 500
    assert inside(tool_of_ur5(pool.joints[on_floor]), block, 100.0).max() < 0.5


@pytest.mark.parametrize(("touches", "pool", "seed"), [(30, 400, 7), pytest.param(40, 400, 3, marks=pytest.mark.long)])
def test_no_way_that_is_called_clear_leads_through_block_or_plates(touches, pool, seed):
    """From above one touch to above the next, down to it and back: the tool keeps out of plates 20 mm thick."""
    source = load_problem(UR5)
    made = plan(source.problem, source.cell, touches=touches, pool=pool, starts=1, seed=seed)
    way, labels = approaches(source.problem, made, source.cell), made.samples.labels["plane"]
    steps, looked = np.linspace(0, 1, 1000)[:, None], 0
    for k, (touch, label) in enumerate(zip(made.samples.joints, labels, strict=True)):
        if not way.clear[k]:
            continue
        ends = [way.above[k], touch]
        if k and np.isfinite(way.above[k - 1]).all():
            ends = [way.above[k - 1], *([way.via[k]] if np.isfinite(way.via[k]).all() else []), *ends]
        for start, end in pairwise(ends):
            tool = tool_of_ur5(start + (end - start) * steps)
            for face in source.cell.faces:
                if face.label != label or end is not touch:  # where the plunger is pushed in
                    looked += 1
                    deep = inside(tool, face, 100.0 if face.label == "block" else 20.0).max()
                    assert deep < 0.5, f"the way to touch {k + 1} leads {deep:.1f} mm into {face.label}"
    assert looked > 100


def test_a_way_down_that_is_blocked_is_begun_from_further_up():
    """Of two touches: from the lower level the way down to either is blocked, from the upper one it is free."""
    touches, levels = np.array([[0.0, 0], [10, 0]]), [np.array([[0.0, h], [10, h]]) for h in (1, 2)]

    def clear(start, end, *, reading=0.0, touched=""):
        assert (reading, touched) in ((0.0, ""), (5.0, "floor"))
        return not (touched and start[1] == 1)

    found = _StraightWays(clear, levels, touches, np.full(2, 5.0), ["floor"] * 2).found()
    assert [each.tolist() for each in found[:2]] == [[1, 1], [True, True]]
    never = _StraightWays(lambda *_, touched="", **__: not touched, levels, touches, np.full(2, 5.0), ["floor"] * 2)
    assert never.found()[1].tolist() == [False, False]


def test_a_way_is_looked_at_in_steps_that_no_thin_thing_fits_between():
    """A post of 3 mm stands half way between two of sixty postures, which its tip passes 8 mm apart."""
    source = load_problem(UR5)
    pool = pool_of(source.problem, source.cell, 50, 0)
    arm, *_ = drawn_touch(source.problem, source.problem.instrument.probe, pool)
    start = np.array([-0.5, -1.6, -1.0, -2.0, 1.5, 0.0])
    end = start + np.eye(6)[0]
    (middle,), _ = arm.place(arm.local, (start + end)[None] / 2, np.zeros((1, 1)))
    far = Cell(faces=plate((5000.0, 0.0, 0.0), size=10.0))
    post = (tuple(zip(middle - 1.5, middle + 1.5, strict=True)),)
    for boxes, free in (((), True), (post, False)):
        around = Clearance(boxes, 0.0).around(source.problem.robot, replace(far, table=-1000.0))
        assert _is_clear(arm, far, around, start, end) == free


def test_a_single_face_without_a_label_is_touched_from_above(hsr):
    """Its own face does not stand in the way down to it."""
    alone = Problem(hsr.problem.robot, DialOnPlane(noise_std=0.01, plane=Plane()))
    cell = Cell(faces=plate((1200.0, 0.0, 300.0)))
    made = plan(alone, cell, touches=12, pool=200, starts=1, seed=1)
    assert not made.samples.labels
    way = approaches(alone, made, cell)
    assert way.clear.sum() >= 11


@pytest.fixture(scope="module")
def two_faces(hsr):
    """A plan that leaves a face out, the arm that answers, and a session after all of it."""
    made = plan(hsr.problem, hsr.cell, touches=14, pool=600, starts=1)
    assert len(set(made.samples.labels["plane"])) == 2
    session = Session(hsr.problem, made, tolerance=0.2, cell=hsr.cell)
    world = World(hsr.problem, made, seed=2)
    return taken(session, world, range(1, len(made) + 1))


def test_further_touches_are_on_faces_that_were_touched(two_faces):
    proposed, known = two_faces.next(), two_faces.known
    assert proposed.number is None
    assert known.knows(proposed)
    further = two_faces._setting.further
    there = covered(known.bound, further)
    assert 0 < there.sum() < len(there), "some are on the face that the plan left out"
    best = Pool.of(known, further).samples.joints[
        Pool.of(known, further).most_telling(known.covariance, two_faces.field)
    ]
    assert proposed.joints == pytest.approx(best)
    none = Pool.of(known, further.take(np.flatnonzero(~there)))
    assert none.needed(known, two_faces.field, 1e-9) is None


def test_a_touch_in_doubt_stays_in_doubt_when_another_is_taken_back(hsr):
    made = plan(hsr.problem, hsr.cell, touches=40, pool=300, starts=1, check=0.1, seed=3)
    world = World(hsr.problem, made, seed=5)
    late = max(k for k, purpose in enumerate(made.purposes, 1) if purpose == "check")
    session = taken(Session(hsr.problem, made), world, (k for k in range(1, 41) if k != late))
    joints, reading, plane = world.touch(late)
    doubted = session.take(joints, reading + 2.0, plane, number=late)
    assert doubted.alarm is not None
    after = doubted.undo(1)
    assert after.alarm is not None
    assert after.touches[after.alarm.raised_by].number == late
    assert doubted.undo(len(doubted) - 1).alarm is None


@pytest.mark.usefixtures("set_ups_of_few")
def test_a_box_out_of_reach_is_said_before_anybody_touches(tmp_path, capsys):
    out, plan_file = tmp_path / "s.csv", str(tmp_path / "plan.csv")
    assert main(["plan", HSR, "--out", plan_file, "--touches", "12", "--pool", "40"]) == 0
    capsys.readouterr()
    metres = "0.8:1.2,-0.3:0.3,0.3:0.6"
    assert main(["measure", HSR, "--plan", plan_file, "--out", str(out), "--box", metres]) == 2
    said = capsys.readouterr()
    assert "put the tip inside the box" in said.err
    assert "joints" not in said.out, "no posture was asked for"


def test_rows_of_a_plan_that_were_left_out_are_said(hsr, tmp_path):
    made, file = plan(hsr.problem, hsr.cell, touches=12, pool=40, starts=1), tmp_path / "plan.csv"
    write_plan(file, made, hsr.problem, hsr.name)
    ways = {"table": 0.0, "clearance": Clearance()}
    assert not renumbered(file)
    _, said = begun(hsr, file, tmp_path / "a.csv", PLAIN, **ways)
    assert said == []
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:-4], *lines[-2:]]) + "\n")
    assert len(read_route(file, hsr.problem.layout())) == 10
    _, (said,) = begun(hsr, file, tmp_path / "b.csv", PLAIN, **ways)
    assert "plan.csv were left out, moved or added" in said


def test_commands_are_obeyed_where_no_further_touch_is_found(hsr, two_faces, tmp_path):
    """The page would otherwise refuse every line, also the one that takes a touch back."""
    made, file = plan(hsr.problem, hsr.cell, touches=12, pool=40, starts=1), tmp_path / "plan.csv"
    write_plan(file, made, hsr.problem, hsr.name)
    recording, _ = begun(hsr, file, tmp_path / "s.csv", PLAIN, table=0.0, clearance=Clearance())
    every = frozenset(range(len(two_faces._setting.further)))
    recording.session = replace(two_faces, declined=every, plan=recording.session.plan)
    with pytest.raises(CasacalError, match="No further touch"):
        _ = recording.proposed
    assert recording.enter("h").said
    assert "No touch is proposed" in recording.enter("1.25").said[0] or recording.enter("1.25").change == "none"


@pytest.mark.usefixtures("set_ups_of_few")
def test_a_large_part_to_verify_leaves_rows_to_fit(tmp_path, capsys):
    for touches in ("15", "17"):
        out = tmp_path / f"{touches}.csv"
        assert main(["plan", HSR, "--touches", touches, "--check", "0.6", "--pool", "60", "--out", str(out)]) == 0
        assert "warning" in capsys.readouterr().out
        assert out.is_file()


def test_set_ups_and_tilt_are_of_what_touches_faces(tmp_path, capsys):
    out = tmp_path / "t.csv"
    plain = ["plan", THREE, "--instrument", "tracker", "--touches", "12", "--pool", "40", "--out", str(out)]
    for more, words in ((["--setups"], "touches no faces"), (["--tilt", "5"], "touches none")):
        assert main([*plain, *more]) == 2
        assert words in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.usefixtures("set_ups_of_few")
def test_no_second_block_is_offered(capsys, tmp_path):
    """The UR5's cell has one, and --block would refuse another."""
    options = ["plan", UR5, "--touches", "12", "--pool", "60", "--setups", "--json", "--out", str(tmp_path / "p.csv")]
    assert main(options) == 0
    offered = json.loads(capsys.readouterr().out)
    assert "--tilt" in json.dumps(offered)
    assert "--block" not in json.dumps(offered)


def test_planned_touches_of_an_arm_whose_gears_err_are_on_their_faces(hsr, two_faces):
    """Joint values are recorded as the controller shows them, where gears err by a wave."""
    still = replace(hsr.cell, repeatability=0.0, resolution=0.0, gear_waves=((100, 1e-4),))
    route = two_faces.plan
    for samples in (20, route.samples):
        made = simulate(hsr.problem, still, samples=samples, seed=1)
        rows = made.samples
        when = np.zeros(len(rows))
        tips = made.true_tips(rows.joints, readings=rows.columns["reading"], when=when)
        faces = {face.label: face for face in still.faces}
        off = [(tips[k] - faces[label].centre) @ faces[label].axes[0] for k, label in enumerate(rows.labels["plane"])]
        assert np.abs(off).max() < 1e-6


@pytest.mark.parametrize("pattern", [r"(?P<value>.*?)\s*mm", r"--\.-- mm|(?P<value>\d+)"])
def test_a_pattern_of_ones_own_that_lets_through_no_number(pattern):
    with pytest.raises(CasacalError, match="holds no number"):
        gauge("plain", pattern=pattern).reading("--.-- mm")
