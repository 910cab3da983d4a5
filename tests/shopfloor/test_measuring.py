"""Sessions: the filter's belief against other ways to it, slips against their names, and what a session must not do."""

import math
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ROOT
from measured_world import World, taken
from scipy.optimize import least_squares
from scipy.stats import chi2, multivariate_normal

from casacal import CasacalError, Problem, bind, lm, load_problem, plan
from casacal.model.capsules import Skeleton
from casacal.model.instrument import readings_within
from casacal.planning import read_route
from casacal.planning.clearance import Clearance
from casacal.planning.plan import write_plan
from casacal.shopfloor import Session
from casacal.shopfloor.conversation import answered, doubt, ended, out_of_travel, posture, to_expect, told
from casacal.shopfloor.gauges import gauge
from casacal.shopfloor.known import LinearRows, _fitted, error_below, spectrum
from casacal.shopfloor.recording import begun
from casacal.shopfloor.touch import Touch, rows_of, slips_of
from casacal.uncertainty.tip_error import expected_accuracy

UR5, SCARA = (ROOT / "problems" / name for name in ("ur5", "adept_cobra600"))


@pytest.fixture(scope="module")
def route(hsr):
    return plan(hsr.problem, hsr.cell, touches=50, pool=600, starts=1, check=0.1, seed=3)


@pytest.fixture(scope="module")
def world(hsr, route):
    return World(hsr.problem, route, seed=5)


@pytest.fixture(scope="module")
def late(hsr, route, world):
    """After forty touches."""
    return taken(Session(hsr.problem, route), world, range(1, 41))


def test_the_belief_is_what_least_squares_find(late):
    """SciPy with the same prior, faces within what a filter starts with of where they began; LM and the tip error by
    the formula of the reports, where faces may stand anywhere: that pulls the turn of the base by parts of a sigma.
    """
    rows = rows_of([touch for touch in late.touches if touch.purpose != "check"])
    bound = bind(late.problem, rows)
    found = lm(bound)
    arm = [name for name in bound.names if not name.startswith("plane.")]
    here = [late.names.index(name) for name in arm]
    there = [bound.names.index(name) for name in arm]
    std = np.sqrt(np.diagonal(found.covariance))[there]
    spread = late.belief.root @ late.belief.root.T
    known = late.known.bound
    same = least_squares(
        lambda v: np.concatenate([known.residual(known.x0 + known.start_std * v), v]), late.known.belief.mean
    )
    gap = np.linalg.cholesky(same.jac.T @ same.jac).T @ (late.known.belief.mean - same.x)
    assert np.linalg.norm(gap) < 0.01, "standard deviations, in any direction"
    near = np.where([name == "theta1" for name in arm], 0.1, 0.05)  # theta1 is the turn of the base
    assert (np.abs(late.belief.mean[here] - found.x[there]) < near * std).all()
    assert (np.abs(late.belief.mean[here]) > 3 * std).any(), "touches told something"
    assert np.sqrt(np.diagonal(spread))[here] == pytest.approx(std, rel=0.03)
    assert late.tip_error == pytest.approx(expected_accuracy(bound, found.x)[1], rel=0.01)


def test_a_covariance_short_of_positive_is_a_belief_all_the_same(late, monkeypatch):
    bound = late.state.known.bound
    found, across = lm(bound), np.eye(bound.x0.size)[0]
    scaled = found.covariance / np.outer(bound.start_std, bound.start_std)
    flat = scaled - np.outer(scaled[0], scaled[0]) / scaled[0, 0] - 1e-13 * np.outer(across, across)
    with pytest.raises(np.linalg.LinAlgError):
        np.linalg.cholesky(flat)
    short = SimpleNamespace(x=found.x, covariance=flat * np.outer(bound.start_std, bound.start_std))
    monkeypatch.setattr("casacal.shopfloor.known.lm", lambda _: short)
    root = _fitted(bound).root
    np.testing.assert_allclose(root @ root.T, flat, atol=1e-12)


def test_it_expects_less_with_every_touch(hsr, route, world):
    session, before = Session(hsr.problem, route), math.inf
    assert session.tip_error is None
    assert session.belief is None
    assert not session.done
    for number in range(1, 30):
        session = session.take(*world.touch(number), number=number)
        assert session.tip_error <= before * (1 + 1e-4)
        before = session.tip_error
    assert session.tip_error < 0.5 * 3.03, "what is known beforehand"


def test_nineteen_of_twenty():
    """Against two hundred thousand draws."""
    rng = np.random.default_rng(2)
    field, root = rng.normal(size=(30, 6)), np.tril(rng.normal(size=(6, 6))) * np.geomspace(1, 0.03, 6)
    moves = (field @ root @ rng.normal(size=(6, 200_000))).reshape(10, 3, -1)
    drawn = np.sqrt((moves**2).sum(axis=1).mean(axis=0))
    weights = spectrum(root, field)
    assert np.sqrt(weights.sum()) == pytest.approx(np.sqrt((drawn**2).mean()), rel=0.01)
    assert error_below(weights) == pytest.approx(np.quantile(drawn, 0.95), rel=0.01)
    assert error_below(weights, 0.5) == pytest.approx(np.quantile(drawn, 0.5), rel=0.03)


def slipped(kind, joints, reading, face):
    other = joints.copy()
    if kind == "sign":
        return joints, -reading, face
    if kind == "revolution":
        return joints, reading - 1.0, face
    if kind == "label":
        return joints, reading, next(name for name in ("floor", "wall", "side") if name != face)
    if kind == "digit":
        return joints, reading + (3.0 if reading < 6 else -3.0), face
    if kind == "unit":
        return joints, reading / 25.4, face
    if kind == "joints swapped":
        other[[1, 2]] = other[[2, 1]]
    if kind == "joint":
        other[0 if face == "side" else 1] += math.radians(3.0)  # joint 2 moves the tip along that face
    return other, reading, face


def test_no_slip_is_named_that_the_dial_cannot_show(hsr, world):
    """A dial of 0 to 10 mm shows no sign, and no turn less than none."""
    joints, _, face = world.touch(7)
    touch = Touch(joints, {"reading": 0.4}, {"plane": face})
    named = slips_of(hsr.problem, touch, None, {"plane": ("floor", "wall", "side")})
    assert {slip.kind for slip in named} >= {"revolution", "digit", "label"}
    assert min(slip.touch.columns["reading"] for slip in named) >= -0.1
    either_way = hsr.problem.with_settings({"travel": (-5.0, 5.0)})
    assert any(slip.kind == "sign" for slip in slips_of(either_way, touch, None, {"plane": ("floor", "wall", "side")}))


def test_joint_values_typed_in_radians_are_named(late, world):
    """Their numbers, taken for degrees: an arm that stands nearly straight."""
    number = next(n for n in range(41, 60) if world.touch(n)[2] == "floor" and late.planned(n).purpose == "fit")
    joints, reading, face = world.touch(number)
    first = late.take(np.radians(joints), reading, face, number=number).alarm.suspects[0]
    assert first.slip.kind == "radians"
    np.testing.assert_allclose(first.slip.touch.joints, joints, atol=1e-12)


@pytest.mark.long_unless("label", "joints swapped")
@pytest.mark.parametrize("kind", ["sign", "revolution", "label", "digit", "unit", "joints swapped", "joint"])
def test_a_slip_is_named_and_put_right(late, world, kind):
    told, first = [], []
    for number in (41, 42, 43):
        right = world.touch(number)
        session = late.take(*slipped(kind, *right), number=number)
        if session.planned(number).purpose == "check":
            continue
        assert session.alarm.touch == 40
        assert abs(session.alarm.off) > 3 * session.alarm.std
        assert session.state.off[0] == pytest.approx(session.alarm.off, rel=0.1), "said twice, on two ways"
        assert session.belief.mean == pytest.approx(late.belief.mean, abs=1e-6), "what is in doubt is not believed"
        assert session.undo().touches == late.touches
        kept = session.keep()
        assert kept.touches[-1].kept
        assert len(kept) == 41
        assert kept.alarm is None or kept.alarm.touch != 40, "the word of the operator stands"
        suspects = [each for each in session.alarm.suspects if each.slip is not None and each.slip.kind == kind]
        told.append(bool(suspects))
        first.append(session.alarm.suspects[0] in suspects)
        for suspect in suspects:
            mended = session.correct(suspect)
            touch = mended.touches[-1]
            if (
                mended.alarm is None
                and touch.joints == pytest.approx(right[0], abs=2e-6)
                and touch.labels["plane"] == right[2]
            ):
                assert touch.columns["reading"] == pytest.approx(right[1], abs=2e-3)
                break
        else:
            told[-1] &= kind == "digit"  # of several that fit no data can say which
    assert len(told) > 1
    assert sum(told) >= len(told) - 1
    assert kind in ("unit", "joint", "digit") or sum(first) >= len(first) - 1


def test_an_early_slip_is_named_when_the_arm_is_known(hsr, route, world):
    """A turn of the pointer lost in the fourth touch: no larger than what the drawing may be wrong by, at first."""
    session = taken(Session(hsr.problem, route), world, range(1, 4))
    joints, reading, face = world.touch(4)
    session = session.take(joints, reading - 1.0, face, number=4)
    assert session.alarm is None
    innocent = 0
    for number in range(5, 46):
        session = session.take(*world.touch(number), number=number)
        while session.alarm is not None and all(suspect.touch != 3 for suspect in session.alarm.suspects):
            session, innocent = session.keep(), innocent + 1
        if session.alarm is not None:
            break
    named = next(suspect for suspect in session.alarm.suspects if suspect.touch == 3)
    assert innocent <= 2
    assert named.slip.kind == "revolution"
    assert session.correct(named).alarm is None


def test_touches_kept_to_verify_that_do_not_agree_are_said_so(hsr, route, late):
    """One alone against SciPy's chi-square; several together that are off as far as a turn of the pointer."""
    touches = list(late.touches)
    kept = [k for k, touch in enumerate(touches) if touch.purpose == "check"]
    rest = [touch for k, touch in enumerate(touches) if k not in kept]
    one = late.resumed([*rest, touches[kept[0]]])
    (off,), (std,) = one.checked()
    assert one.checked_chance() == pytest.approx(chi2.sf(float(off[0] / std[0]) ** 2, 1), rel=1e-6)
    assert not any("do not agree" in line for line in ended(late))
    moved = [replace(touches[k], columns={"reading": touches[k].columns["reading"] + 1.0}) for k in kept]
    said = ended(late.resumed([*rest, *moved]))
    assert any("warning: so far off they do not agree" in line and "casacal check" in line for line in said)
    assert late.resumed(rest).checked_chance() == 1.0


@pytest.mark.long
def test_what_is_right_is_left_alone(hsr, route):
    """Five arms, fifty touches each, faces elsewhere than planned: below one of a hundred is doubted."""
    doubts = 0
    for seed in range(5):
        world = World(hsr.problem, route, seed=seed, faces=(8.0, 8e-3))
        session = Session(hsr.problem, route)
        for number in range(1, 51):
            session = session.take(*world.touch(number), number=number)
            while session.alarm is not None:
                session, doubts = session.keep(), doubts + 1
        off, std = session.checked()
        assert len(off) == 5
        assert (np.abs(off) < 4 * std).all()
        assert session.noise == 1.0
        assert session.next() is None
    assert doubts <= 2


@pytest.mark.parametrize("wrong", ["joint 4", "faces", "dial"])
def test_who_accepts_one_untrue_suggestion_after_the_other_is_told(hsr, route, world, wrong):
    """What is wrong is shared by all touches; each suggestion fits, and the expected error would shrink with each."""
    session, errors = Session(hsr.problem, route), []
    for number in range(1, 31):
        joints, reading, face = world.touch(number)
        joints[3] += 0.2 * (wrong == "joint 4")
        face = {"side": "wall", "wall": "side"}.get(face, face) if wrong == "faces" else face
        session = session.take(joints, reading / 2 if wrong == "dial" else reading, face, number=number)
        while session.alarm is not None and session.alarm.suspects[0].slip is not None:
            session = session.correct()
        session = session if session.alarm is None else session.undo()
        errors.append(session.tip_error)
        if session.distrusted:
            break
    assert session.distrusted
    assert None not in errors[:-1]
    assert session.tip_error is session.tip_error_below is None
    assert not replace(session, tolerance=100.0).done, "any error is below"
    assert f"{len(session.corrected)} of {len(session)} touches were corrected" in ended(session)[0]
    for k in reversed(session.corrected):
        session = session.undo(k)
    assert session.tip_error is not None


def test_corrections_that_people_need_are_no_ground_for_distrust(late):
    """At one of twenty, two are usual of forty and eight are not."""
    touches = [replace(touch, corrected=k % 10 == 0) for k, touch in enumerate(late.touches)]
    assert len((few := replace(late, touches=tuple(touches))).corrected) == 4
    assert not few.distrusted
    many = replace(late, touches=tuple(replace(touch, corrected=k % 5 == 0) for k, touch in enumerate(late.touches)))
    assert many.distrusted
    assert "No tip error is promised" in ended(many)[0]


def test_noise_beyond_the_stated_is_found_and_counted(hsr, route, late):
    world = World(hsr.problem, route, seed=5, noise=6.0)
    session = Session(hsr.problem, route)
    for number in range(1, 51):
        session = session.take(*world.touch(number), number=number)
        while session.alarm is not None:
            session = session.keep()
    assert 3.5 < session.noise < 10
    assert session.tip_error > 1.2 * late.tip_error


def test_without_a_plan_it_waits_for_the_faces(hsr, route, world):
    session, seen = Session(hsr.problem), {}
    for number in range(1, 30):
        joints, reading, face = world.touch(number)
        session = session.take(joints, reading, face)
        seen[face] = seen.get(face, 0) + 1
        waiting = {session.touches[k].labels["plane"] for k in session.waiting}
        assert waiting == {name for name, count in seen.items() if count < 4}
    assert session.next() is None
    assert session.alarm is None
    assert session.tip_error < 2.5
    assert rows_of(session.touches).faces().names == tuple(seen)


def test_a_plunger_along_a_face_touches_nothing(hsr, route, late):
    """At zero joint values the plunger points down, along both walls."""
    for session in (late, Session(hsr.problem, route)):
        for face in ("wall", "side"):
            with pytest.raises(CasacalError, match=f"parallel to '{face}'"):
                session.take(np.zeros(6), 3.2, face)
        assert session.take(np.zeros(6), 3.2, "floor").alarm.touch == len(session)


def test_steps_that_cannot_be_taken_are_refused(hsr, route, world, late):
    joints, reading, face = world.touch(41)
    doubtful = late.take(joints, -reading, face, number=41)
    with pytest.raises(CasacalError, match=r"Touch 41 is in doubt. Answer first"):
        doubtful.take(joints, reading, face)
    stray = next(each for each in doubtful.alarm.suspects if each.slip is not None)
    assert doubtful.correct(stray).alarm is None
    for wrong, words in (
        (lambda: late.keep(), "No touch is in doubt"),
        (lambda: late.correct(), "No touch is in doubt"),
        (lambda: late.take(joints[:5], reading, face), r"shape \(5,\)"),
        (lambda: late.take(joints * np.nan, reading, face), "not finite"),
        (lambda: late.take(joints * 1000, reading, face), "no robot can take"),
        (lambda: late.take(joints, None, face), "Got nothing as the reading"),
        (lambda: late.take(joints, "3.2", face), "Got a str as the reading"),
        (lambda: late.take(joints, {"way": 3.2}, face), "'way'"),
        (lambda: late.take(joints, reading, "flor"), "Did you mean 'floor'"),
        (lambda: late.take(joints, reading), "has no plane"),
        (lambda: late.take(joints, reading, face, number=51), "the plan has 1 to 50"),
        (lambda: late.undo(40), "no touch 40"),
        (lambda: Session(hsr.problem).undo(), "no touch to take back"),
        (lambda: Session("arm"), "as the problem"),
        (lambda: Session(hsr.problem, "plan.csv"), "as the plan"),
        (lambda: Session(hsr.problem, tolerance=-1.0), "as the tolerance"),
    ):
        with pytest.raises(CasacalError, match=words):
            wrong()


def test_sessions_are_values(late, world):
    again = pickle.loads(pickle.dumps(late))
    assert again == late
    assert again.tip_error == pytest.approx(late.tip_error, rel=1e-12)
    with ThreadPoolExecutor(2) as pool:
        both = list(pool.map(lambda number: late.take(*world.touch(number), number=number), (41, 42)))
    assert [each.touches[-1].number for each in both] == [41, 42]
    assert len(late) == 40
    assert late.resumed(late.touches).belief.mean == pytest.approx(late.belief.mean, abs=1e-9)
    assert late.undo().undo().touches == late.touches[:-2]
    assert repr(late).startswith("<Session of 40 touches: tip error")


def test_a_touch_may_be_left_out(hsr, route):
    session = Session(hsr.problem, route)
    assert session.next().number == 1
    assert session.skip(1).skip(2).next().number == 3
    assert session.next().number == 1
    assert session.skip(1).skip(2).skip(1).next().number == 1, "what was left out is asked for again"


@pytest.mark.long
def test_beyond_the_plan_the_best_is_proposed_until_the_tolerance_is_met(hsr):
    route = plan(hsr.problem, hsr.cell, touches=24, pool=400, starts=1, check=0.0, again=0.0)
    world = World(hsr.problem, route, seed=1)
    session = taken(Session(hsr.problem, route, tolerance=1.2, cell=hsr.cell), world, range(1, 25))
    assert not session.done
    needed, before = session.needed(), session.tip_error_below
    assert 1 <= needed <= 30
    touch = session.next()
    assert touch.number is None
    for _ in range(needed):
        assert not session.done
        touch = session.next()
        rows = rows_of([touch])
        off = world.bound.on(rows).plain_residual(world.x)
        slope = (
            world.bound.on(
                rows_of([touch.__class__(touch.joints, {"reading": touch.columns["reading"] + 1e-3}, touch.labels)])
            ).plain_residual(world.x)
            - off
        )
        session = session.take(
            touch.joints, touch.columns["reading"] - float((off / slope)[0]) * 1e-3, touch.labels["plane"]
        )
        assert session.alarm is None
    assert session.done
    assert session.next() is None
    assert session.tip_error_below < before


@pytest.mark.long
def test_a_tolerance_that_cannot_be_met_is_said(hsr, route, late):
    from dataclasses import replace

    assert replace(late, tolerance=0.01).needed() is None
    assert replace(late, tolerance=0.9 * late.tip_error_below).needed() > 0
    assert replace(late, tolerance=1.1 * late.tip_error_below).done


@pytest.mark.long
def test_faces_of_few_touches_do_not_spoil_a_session():
    """A UR5 errs by three millimetres, and a face begins with three touches near one another: nothing is doubted."""
    source = load_problem(UR5)
    route = plan(source.problem, source.cell, touches=52, pool=400, starts=1, seed=1)
    doubts = 0
    for seed in range(8):
        world, session = World(source.problem, route, seed=seed), Session(source.problem, route)
        for number in range(1, 53):
            session = session.take(*world.touch(number), number=number)
            while session.alarm is not None:
                session, doubts = session.keep(), doubts + 1
        assert session.noise == 1.0
        assert world.tip_error(session.belief.mean) < 4 * session.tip_error
    assert doubts <= 4, "one of a hundred"


@pytest.mark.long
def test_faces_that_nobody_planned_move_to_where_they_are():
    """Four touches of an arm that errs by millimetres place a face badly; that is no knowledge to go by."""
    source = load_problem(UR5)
    route = plan(source.problem, source.cell, touches=52, pool=400, starts=1, seed=1)
    errors = []
    for seed in range(4):
        world, session = World(source.problem, route, seed=seed), Session(source.problem)
        for number in range(1, 53):
            session = session.take(*world.touch(number))
            while session.alarm is not None:
                session = session.keep()
        assert session.noise == 1.0
        places = {name: k for k, name in enumerate(session.names)}
        x = np.array([session.belief.mean[places[name]] for name in world.bound.names])
        errors.append(world.tip_error(x) / session.tip_error)
    assert max(errors) < 4


def test_touches_on_a_line_wait(hsr, route, world):
    """Nobody planned, and four touches of the floor lie on a line: where it is, they do not say."""
    joints, session = next(q for q, _, face in map(world.touch, range(1, 51)) if face == "floor"), Session(hsr.problem)
    for reading in (3.0, 3.1, 3.2, 3.3):
        session = session.take(joints, reading, "floor")
    assert len(session.waiting) == 4
    assert session.alarm is None
    assert session.tip_error is None


def test_a_face_whose_fourth_touch_is_in_doubt_waits(hsr, world):
    """Three touches are as many as a face has unknowns, so without the one in doubt they tell nothing of it."""
    touches = [world.touch(number) for number in range(1, 51)]
    session = Session(hsr.problem)
    for touch in [each for each in touches if each[2] != "floor"]:
        session = session.take(*touch)
        session = session if session.alarm is None else session.keep()
    floor = [each for each in touches if each[2] == "floor"][:4]
    for joints, reading, face in floor[:3]:
        session = session.take(joints, reading, face)
    joints, reading, face = floor[3]
    doubted = session.take(joints, reading + 4.0, face)
    assert doubted.alarm is not None
    assert len(doubted.undo()) == len(session)


@pytest.mark.long
def test_a_plan_gives_every_face_enough(hsr):
    ur5 = load_problem(UR5)
    for source, touches, starts in ((hsr, 20, 1), (hsr, 34, 1), (hsr, 20, 2), (ur5, 12, 2), (ur5, 24, 1)):
        made = plan(source.problem, source.cell, touches=touches, pool=400, starts=starts)
        faces = ["floor" if name == "block" else name for name in made.samples.labels["plane"]]  # it stands on that
        fitted = [faces[k] for k, purpose in enumerate(made.purposes) if purpose == "fit"]
        assert all(fitted.count(name) >= 4 for name in set(fitted))
        checked = {faces[k] for k, purpose in enumerate(made.purposes) if purpose == "check"}
        assert checked <= set(fitted)
        session = Session(source.problem, made).take(*World(source.problem, made).touch(1), number=1)
        assert not session.waiting


@pytest.mark.long_unless("adept_cobra600")
@pytest.mark.parametrize("folder", [UR5, SCARA], ids=lambda folder: folder.name)
def test_other_arms(folder):
    source = load_problem(folder)
    route = plan(source.problem, source.cell, touches=40, pool=300, starts=1, check=0.0, seed=1)
    world = World(source.problem, route, seed=2, faces=(2.0, 2e-3))
    session = taken(Session(source.problem, route), world, range(1, 31))
    joints, reading, face = world.touch(31)
    wrong = session.take(joints, -reading, face, number=31)
    assert wrong.alarm.suspects[0].slip.kind == "sign"
    assert world.tip_error(session.belief.mean) < 3 * session.tip_error


def test_the_very_first_touch_may_be_wrong(hsr, route, world):
    """On another face, some tenths of a metre away, before anything is known."""
    named = 0
    for number in range(1, 12):
        joints, reading, face = world.touch(number)
        for other in {"floor", "wall", "side"} - {face}:
            try:
                session = Session(hsr.problem, route).take(joints, reading, other, number=number)
            except CasacalError:  # the plunger lies along the face that was named, which is said at once
                continue
            if session.alarm is None or route.purposes[number - 1] == "check":
                continue
            assert session.alarm.touch == 0
            assert session.alarm.suspects[0].slip.kind == "label"
            assert session.belief is None
            assert session.correct().touches[0].labels["plane"] in {"floor", "wall", "side"} - {other}
            assert len(session.undo()) == 0
            named += 1
    assert named > 3


def test_after_a_correction_all_is_as_if_nothing_had_been_wrong(hsr, route, world):
    """A turn of the pointer too many in the last of twenty touches, put right."""
    before = taken(Session(hsr.problem, route), world, range(1, 20))
    joints, reading, face = world.touch(20)
    wrong, right = (before.take(joints, each, face, number=20) for each in (reading + 1.0, reading))
    assert wrong.alarm is not None
    put_right = wrong.correct(next(each for each in wrong.alarm.suspects if each.slip and each.touch == 19))
    assert put_right.touches[19].columns["reading"] == pytest.approx(reading, abs=1e-9)
    np.testing.assert_allclose(put_right.belief.mean, right.belief.mean, atol=1e-9)
    np.testing.assert_allclose(put_right.belief.root, right.belief.root, atol=1e-9)


def test_the_best_of_the_plan_comes_first_where_that_is_asked(hsr, route, world):
    """Each row's part in the tip error by an inverse of its own; fewer touches then leave less."""
    wished, plain = Session(hsr.problem, route, best_first=True), Session(hsr.problem, route)
    order = []
    for count in range(1, 21):
        touch = wished.next()
        order.append(touch.number)
        if count == 15:
            known, left = wished.state.known, [k for k in range(1, 51) if k not in order[:-1]]
            fit = [k for k in left if route.purposes[k - 1] == "fit"]
            bound = known.bound.on(route.samples.take(np.array(fit) - 1))
            slopes = bound.jacobian(known.x) * bound.start_std
            information = np.linalg.inv(known.belief.root @ known.belief.root.T)
            moves = wished.field.reshape(-1, slopes.shape[1])
            errors = [np.trace(moves @ np.linalg.inv(information + np.outer(a, a)) @ moves.T) for a in slopes]
            assert touch.number == fit[int(np.argmin(errors))]
        wished = wished.take(*world.touch(touch.number), number=touch.number)
        plain = plain.take(*world.touch(count), number=count)
        assert wished.alarm is None
    assert len(set(order)) == 20
    assert order != list(range(1, 21))
    assert wished.tip_error < 0.9 * plain.tip_error
    assert all(route.purposes[number - 1] == "fit" for number in order)
    while (touch := wished.next()) is not None:
        assert touch.number is not None
        wished = wished.skip(touch.number)


def test_touches_beyond_the_plan_keep_clear(hsr, route, world):
    made = taken(Session(hsr.problem, route, tolerance=0.05, cell=hsr.cell), world, range(1, 26))
    for number in range(26, 51):
        made = made.skip(number)
    free = made.next()
    wrist = Skeleton.of(hsr.problem.robot).place(free.joints[None])[0, -1]
    box = tuple((float(value) - 60.0, float(value) + 60.0) for value in wrist)
    kept = Session(hsr.problem, route, tolerance=0.05, cell=hsr.cell, clearance=Clearance((box,))).resumed(made.touches)
    for number in range(26, 51):
        kept = kept.skip(number)
    there = Skeleton.of(hsr.problem.robot).place(kept.next().joints[None])[0, -1]
    assert free.number is None
    assert any(not low <= value <= high for value, (low, high) in zip(there, box, strict=True))


def test_the_evidence_of_rows_is_their_density_with_the_arm_integrated_out():
    """log N(r - J m; 0, I + J J'), dense, by SciPy; no formula shared."""
    rng = np.random.default_rng(4)
    r, slope, mean = rng.normal(size=(5, 2)), rng.normal(size=(5, 2, 4)), rng.normal(size=4)
    flat = slope.reshape(10, 4)
    for root in (np.eye(4), np.eye(4) + 0.3 * np.tril(rng.normal(size=(4, 4)))):
        prior = np.linalg.inv(root @ root.T)
        dense = multivariate_normal(cov=np.eye(10) + flat @ root @ root.T @ flat.T).logpdf(r.ravel() - flat @ mean)
        found = LinearRows(r, slope, np.ones((5, 2)), prior).posterior(mean).evidence
        of_all = 5 * math.log(2 * math.pi) - np.linalg.slogdet(prior)[1] / 2  # which all explanations have in common
        assert found == pytest.approx(dense + of_all, rel=1e-9)


def test_a_turn_of_the_pointer_is_forgotten_or_too_many():
    source = load_problem(ROOT / "problems" / "hsr_jr680")
    rows = source.problem.read(source.samples)
    touch = replace(Touch.of(rows.take(np.array([0])), 0, None, "fit"), columns={"reading": 5.0})
    turned = [each for each in slips_of(source.problem, touch, None, {}) if each.kind == "revolution"]
    assert turned
    for slip in turned:
        assert ("forgotten" in slip.words) == (slip.touch.columns["reading"] > 5.0)


@pytest.mark.parametrize(("seed", "apart"), [(2, 20.0), (3, 4.0)])
def test_a_posture_that_would_crush_the_dial_is_warned_of(hsr, route, seed, apart):
    """Faces stand some mm from where they were planned; the true arm and faces say what the dial would read."""
    far = World(hsr.problem, route, seed=seed, faces=(apart, 3e-3))
    samples, planned = route.samples, route.samples.columns["reading"]
    here = far.residual(samples, samples.joints, planned)
    true = planned - here / (far.residual(samples, samples.joints, planned + 1.0) - here)
    session, said = Session(hsr.problem, route), {"do not": 0, "the tip": 0, "": 0}
    assert "as planned; where the face is, no touch has told yet" in to_expect(session, session.next())
    for number in range(1, 31):
        touch, reading = session.next(), float(true[number - 1])
        found, words = told(session, touch), out_of_travel(session, touch) or ""
        if found is not None:
            assert abs(reading - found[0]) < 4.5 * found[1], "not what the true dial would read"
            assert f"reading about {found[0]:.2f} mm" in posture(session, touch)
            well = 1.0 < reading < 9.0 and found[1] < 0.2
            expected = "do not" if reading < -0.2 else "the tip" if reading > 12.0 else "" if well else words[:6]
            assert words.startswith(expected) if expected else not words, (reading, words)
            said[words[:7].strip() if words.startswith("the") else words[:6]] += 1
            assert not words or f"until it reads about {planned[number - 1]:.2f} mm" in words
            assert not words or f"its travel of 0 to 10 mm; {'stand off' if words[0] == 'd' else 'go nearer'}" in words
        assert found is not None or number < 15
        session = session.take(*far.touch(number), number=number)
        session = session if session.alarm is None else session.keep()
    assert said["do not"] > 5
    assert said["the tip" if apart > 10 else ""] > 5


def test_what_is_off_is_said_as_it_is_read(late, world):
    """A reading above the expected one is off by a positive number, as large as the dial shows it."""
    touch = late.next()
    joints, _, _ = world.touch(touch.number)
    expected, std = late.expected(replace(touch, joints=joints))
    for off in (2 * std, -2 * std):
        line = " ".join([*(f"{value:.6f}" for value in np.degrees(joints)), f"{expected + off:.5f}"])
        (words,) = answered(late, touch, line, gauge("plain")).said
        said = float(words.split("; ")[1].partition(" mm from what was expected")[0])
        assert said == pytest.approx(off, rel=0.05, abs=1e-4)
    line = " ".join([*(f"{value:.6f}" for value in np.degrees(joints)), f"{expected - 3.0:.5f}"])
    doubted = next(words for words in answered(late, touch, line, gauge("plain")).said if "is off by" in words)
    assert float(doubted.split("is off by ")[1].partition(" mm")[0]) == pytest.approx(-3.0, rel=0.05)


def test_what_leaving_a_touch_out_costs_is_said(hsr, route):
    session, labels = Session(hsr.problem, route), route.samples.labels["plane"]
    checks = [k for k, purpose in enumerate(route.purposes, 1) if purpose == "check"]
    number, where = checks[0], labels[checks[0] - 1]
    beside = sum(labels[k - 1] == where for k in checks) - 1
    first = answered(session, session.next(), f"s {number}", gauge("plain"))
    assert f"{beside} touch{'' if beside == 1 else 'es'} on {where} to verify" in first.said[0]
    again = answered(first.session, session.next(), f"s {number}", gauge("plain"))
    assert again.said == (f"touch {number} is asked for again",)
    assert again.session.skipped == frozenset()
    other = next(k for k, purpose in enumerate(route.purposes, 1) if purpose == "fit")
    assert "to verify" not in answered(session, session.next(), f"s {other}", gauge("plain")).said[0]


def test_another_touch_beyond_the_plan_is_proposed_where_one_cannot_be_made(hsr, late, world):
    over = replace(late, tolerance=0.01, cell=hsr.cell)
    for number in range(len(late) + 1, len(late.plan) + 1):
        over = over.skip(number)
    proposed = over.next()
    assert proposed.number is None
    answer = answered(over, proposed, "s", gauge("plain"))
    assert answer.said == ("another touch is proposed",)
    other = answer.session.next()
    assert other.number is None
    assert np.abs(other.joints - proposed.joints).max() > 1e-3
    assert answer.session.skip(None).next().joints.tolist() not in ([*proposed.joints], [*other.joints])
    with pytest.raises(CasacalError, match=r"No further touch can be proposed\. Enter joint values and reading"):
        replace(over, declined=frozenset(range(10_000))).next()


def test_where_the_arm_still_stands_the_dial_is_looked_at_first(late, world):
    touch = late.next()
    joints, reading, _ = world.touch(touch.number)
    wrong = " ".join([*(f"{value:.6f}" for value in np.degrees(joints)), f"{(reading + 5) % 10:.3f}"])
    said = answered(late, touch, wrong, gauge("plain")).said
    assert "The arm still stands there: look at the dial again first" in " ".join(said)


def test_the_touch_that_is_named_is_skipped(late):
    touch = late.next()
    after = answered(late, touch, f"s {touch.number + 2}", gauge("plain")).session
    assert after.skipped == {touch.number + 2}
    assert after.next().number == touch.number
    assert answered(late, touch, "s", gauge("plain")).session.skipped == {touch.number}
    for line, words in (("s 3", "u 3 takes it back"), ("s 999", "1 to 50"), ("1,5 2.5 3,5", "here they are mixed")):
        answer = answered(late, touch, line, gauge("plain"))
        assert words in answer.said[0]
        assert answer.session is late


def test_the_end_of_the_dials_travel_is_warned_of(hsr, route):
    planned = Session(hsr.problem, route).next()
    low, high = readings_within(hsr.problem.instrument.probe.travel)
    for reading, warned in ((high, True), (low, True), ((low + high) / 2, False)):
        said = answered(Session(hsr.problem, route), planned, f"{reading:g}", gauge("plain")).said
        assert ("end of its travel" in " ".join(said)) == warned


def test_where_doubts_go_on_the_stated_accuracy_is_named(late, world):
    session = late
    for number, before in ((41, False), (42, True)):
        joints, reading, face = world.touch(number)
        session = session.take(joints, reading + 1.7, face, number=number)
        assert ("kept before" in doubt(session)[0]) == before
        while session.alarm is not None:
            session = session.keep()


def tip_and_plunger(q, reading):
    """Tip (3, mm) and direction (3,) of the HSR's dial as drawn, by its DH matrices; its plunger is along joint 6."""
    table = ((-90, 249.85003, 653.5, 0), (0, 900.32123, 0, -90), (90, -206.14449, 0, 180), (-90, 0, 1030.37534, 0),
             (90, 0, 0, 90), (0, 0, 200.6, 0))  # fmt: skip
    pose = np.eye(4)
    for (alpha, a, d, theta), turn in zip(table, q, strict=True):
        ct, st = np.cos(turn + np.radians(theta)), np.sin(turn + np.radians(theta))
        ca, sa = np.cos(np.radians(alpha)), np.sin(np.radians(alpha))
        pose = pose @ [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]]
    return pose[:3, 3] + reading * pose[:3, 2], pose[:3, 2]


def begun_on_disk(hsr, folder, **options):
    """A recording of a plan of 40 touches in a folder, and its route."""
    if not (folder / "plan.csv").exists():
        made = plan(hsr.problem, hsr.cell, touches=40, pool=300, starts=1, seed=8)
        write_plan(folder / "plan.csv", made, hsr.problem, hsr.name)
    clear = options.pop("clearance", Clearance())
    made, _ = begun(hsr, folder / "plan.csv", folder / "s.csv", gauge("plain"), table=0.0, clearance=clear, **options)
    return made, read_route(folder / "plan.csv", hsr.problem.layout())


def read_truly(far, touch):
    """What the true dial reads at the joint values of a touch."""
    one, planned = rows_of([touch]), np.array([touch.columns["reading"]])
    here = far.residual(one, one.joints, planned)
    return float((planned - here / (far.residual(one, one.joints, planned + 1.0) - here))[0])


@pytest.mark.parametrize(
    ("apart", "tilt", "seed"), [(13.0, 0.0175, 5), pytest.param(40.0, 0.05, 2, marks=pytest.mark.long)]
)
def test_postures_are_moved_to_where_their_plates_stand(hsr, tmp_path, apart, tilt, seed):
    """Plates stand elsewhere than planned: after their first touches nobody looks for them by hand any more."""
    recording, route = begun_on_disk(hsr, tmp_path)
    far, by_hand, moved, doubted, rng = (
        World(hsr.problem, route, seed=seed, faces=(apart, tilt)),
        0,
        0,
        0,
        np.random.default_rng(1),
    )
    warned, far_off = 0, sum(not 0 <= read_truly(far, Touch.of(route.samples, k)) <= 10 for k in range(len(route)))
    for number in range(1, len(route) + 1):
        session, touch = recording.session, recording.proposed
        planned, reading = session.planned(number), read_truly(far, touch)
        assert touch.number == number
        warned += recording.warning is not None  # of a posture that the arm could not take further back
        if not np.array_equal(touch.joints, planned.joints):
            moved += 1
            wanted, before = touch.columns["reading"], session.expected(planned)[0]
            there, along = tip_and_plunger(touch.joints, wanted)
            here, planned_along = tip_and_plunger(planned.joints, before)
            assert there == pytest.approx(here, abs=0.15), "it meets the face at the same place"
            assert along == pytest.approx(planned_along, abs=1e-3), "from the same direction"
            spread = min(3 * session.expected(planned)[1], 5.0)
            assert spread - 1e-9 <= wanted <= 10 - spread + 1e-9, "not where the dial may be crushed"
            way = (before - wanted) * hsr.problem.instrument.sign
            words = f"{abs(way):.1f} mm further {'forward' if way > 0 else 'back'} than planned"
            assert words in posture(session, touch)
        else:
            assert "than planned" not in posture(session, touch)
        if 0 <= reading <= 10:
            answer = recording.enter(f"{reading + rng.normal() * hsr.problem.instrument.noise_std:.3f}")
            assert recording.session.touches[-1].joints == pytest.approx(touch.joints, abs=1e-12)
        else:
            by_hand += 1
            joints, reading, _ = far.touch(number)
            answer = recording.enter(" ".join([*(f"{each:.4f}" for each in np.degrees(joints)), f"{reading:.3f}"]))
        assert answer.change == "added", answer.said
        if recording.session.alarm is not None:
            doubted += 1
            recording.enter("k")
    assert far_off > 20
    assert moved > 20
    assert by_hand <= 10
    assert doubted <= (1 if apart < 20 else 4)
    assert warned <= (0 if apart < 20 else 2)


def test_a_posture_is_not_moved_to_where_the_arm_cannot_go(hsr, tmp_path, monkeypatch):
    """Joint limits, and what it must keep clear of; then the posture of the plan is warned of as before."""
    recording, route = begun_on_disk(hsr, tmp_path)
    far = World(hsr.problem, route, seed=5, faces=(13.0, 0.0175))
    for number in range(1, 11):
        joints, reading, _ = far.touch(number)
        recording.enter(" ".join([*(f"{each:.4f}" for each in np.degrees(joints)), f"{reading:.3f}"]))
    session = recording.session
    number = next(n for n in range(11, 41) if out_of_travel(session, session.planned(n)) is not None)
    planned = session.planned(number)
    assert session.brought(planned) is not None
    pairs = zip(hsr.problem.robot.axes, planned.joints, strict=True)
    tight = tuple(replace(joint, lower=q - 1e-4, upper=q + 1e-4) for joint, q in pairs)
    held = Problem(replace(session.problem.robot, joints=tight), *session.problem.instruments)
    assert replace(session, problem=held).brought(planned) is None

    monkeypatch.setattr("casacal.shopfloor.session.Session.next", lambda session: planned)
    recording._proposed = None
    assert not np.array_equal(recording.proposed.joints, planned.joints)
    monkeypatch.setattr("casacal.shopfloor.recording.hindered", lambda *_: {1: "link 3 against the table"})
    recording._proposed = None
    assert np.array_equal(recording.proposed.joints, planned.joints)
    assert recording.warning == out_of_travel(session, planned)


def test_who_stood_at_the_joint_values_of_the_plan_is_told_so(late, world):
    """A posture was moved, the arm went where a program of the plan sends it, and the reading alone was taken."""
    number = next(n for n in range(41, 51) if late.planned(n).purpose == "fit")
    planned, (joints, _, _) = late.planned(number), world.touch(number)
    assert joints == pytest.approx(planned.joints, abs=0.05)
    mean = replace(late.planned(number), joints=joints)
    moved = joints + np.array([0.004, -0.006, 0.01, 0.003, -0.008, 0.002])
    slips = slips_of(late.problem, replace(mean, joints=moved), replace(planned, joints=joints), {})
    (named,) = (each for each in slips if each.words == "the arm stood at the joint values of the plan")
    assert named.touch.joints == pytest.approx(joints)
    assert not any("as planned" in each.words for each in slips)
    typed = joints.copy()
    typed[2] += 0.1
    words = [
        each.words for each in slips_of(late.problem, replace(mean, joints=typed), replace(planned, joints=joints), {})
    ]
    assert any(each.startswith("joint 3 as planned") for each in words)
    assert "the arm stood at the joint values of the plan" not in words
