"""Joints that give under the weights of links: moments by hand, masses from a URDF, one arm in other conventions."""

import dataclasses
import tempfile

import numpy as np
import pytest
from conftest import ROOT
from instruments_on_ur5 import ROBOT, TABLE, TOOL, flanges

from casacal import (
    Conventions,
    Parameter,
    Problem,
    Robot,
    TrackedPoint,
    bind,
    calibrate,
    lm,
    load,
    load_problem,
    simulate,
    tool_point,
)
from casacal.effects import GravitySag, LinkSag, with_kit
from casacal.errors import ProblemError
from casacal.simulation import Disturbances
from casacal.uncertainty.tip_error import tip_rms, without_rigid, workspace_joints

MASSES = (3.7, 8.4, 2.3, 1.2, 1.2, 0.2)
GIVE = np.array([0.0, 40.0, 60.0, 150.0, 200.0, 300.0]) * 1e-6
"""Radians for each kilogram at a lever of one metre; the first joint stands upright and feels no weight."""
SOFT = np.array([0.0, 100.0, 140.0, 170.0, 200.0, 70.0]) * 1e-6
"""The same of an arm that sags by some tenths of a millimetre."""
AT_ZERO = ((0, -60, 89), (-250, -130, 89), (-600, -20, 89), (-817, -60, 89), (-817, -109, 60), (-817, -150, -6))
"""Centres of mass in the base frame where all joints stand at zero, mm."""


def frames(q):
    """Frames (7, 4, 4) of the drawn arm, base first, by hand."""
    found = [np.eye(4)]
    for turn, alpha, a, d in zip(q, *TABLE, strict=True):
        ct, st, ca, sa = np.cos(turn), np.sin(turn), np.cos(alpha), np.sin(alpha)
        step = [[ct, -st * ca, st * sa, a * ct], [st, ct * ca, -ct * sa, a * st], [0, sa, ca, d], [0, 0, 0, 1]]
        found.append(found[-1] @ np.array(step))
    return np.array(found)


def moments(q, down=(0.0, 0.0, -1.0)):
    """Moment (6,) of all weights beyond about each joint, kg m: axis x arm, by hand."""
    at_zero, here = frames(np.zeros(6)), frames(q)
    centres = [
        here[j + 1] @ np.linalg.inv(at_zero[j + 1]) @ [*AT_ZERO[j], 1.0] for j in range(6)
    ]  # link j + 1 moves as frame j + 1
    return np.array(
        [
            sum(
                MASSES[j] * np.cross(here[i][:3, 2], centres[j][:3] - here[i][:3, 3]) @ down / 1000 for j in range(i, 6)
            )
            for i in range(6)
        ]
    )


def heavy(tracker, seed=3, rows=90):
    """A drawn arm that gives under its weight, its tip seen with 10 um of noise."""
    still = Disturbances(resolution=0.0, repeatability=0.0, error_scale=0.0)
    samples = simulate(Problem(ROBOT, tracker), still, samples=rows, seed=seed).samples
    off = np.array([GIVE * moments(q) for q in samples.joints])
    noise = np.random.default_rng(seed).normal(size=(rows, 3)) * 0.01
    points = flanges(samples.joints + off)[:, :3] @ np.array([*TOOL, 1.0]) + noise
    return dataclasses.replace(samples, columns=dict(zip("xyz", points.T, strict=True)))


TRACKER = TrackedPoint(noise_std=0.01, tool=tool_point(*TOOL, prior_std=1.0))
KNOWN = LinkSag(masses=MASSES, centres=AT_ZERO)


@pytest.fixture(scope="module")
def sagging():
    return heavy(TRACKER)


def test_each_joint_s_give_is_found_where_masses_are_known(sagging):
    bound = bind(Problem(ROBOT, TRACKER, terms=(KNOWN,)), sagging)
    result = lm(bound)
    own = [j for j, key in enumerate(bound.beside) if key == KNOWN.key]
    assert len(own) == 5, "the first joint carries no weight about its axis"
    assert np.abs((result.x[own] - GIVE[1:]) / result.std[own]).max() < 4
    assert (result.std[own][:2] < 0.1 * GIVE[1:3]).all()
    without = lm(bind(Problem(ROBOT, TRACKER), sagging))
    assert without.cost > 5 * result.cost


@pytest.mark.long
def test_without_masses_each_joint_gives_to_each_link_and_is_corrected(sagging):
    effect = LinkSag()
    found = calibrate(Problem(ROBOT, TRACKER, terms=(effect,)), sagging)
    assert abs(found.reference.relative_gap) < 1e-8
    assert found.corrected == ("give",)
    felt = [name for name, key in zip(found.fit.names, found.fit.beside, strict=True) if key == "give"]
    assert 10 <= len(felt) <= 5 * 6 // 2, "each of five joints carries its own link and those beyond, but for axes"
    elsewhere = heavy(TRACKER, seed=8, rows=200)
    truth = flanges(np.array([q + GIVE * moments(q) for q in elsewhere.joints]))[:, :3] @ np.array([*TOOL, 1.0])
    alone = calibrate(Problem(ROBOT, TRACKER), sagging, reference=False, discrepancy="none")
    left = {}
    for name, arm in (("corrected", found), ("geometry", alone)):
        error = arm.predict(elsewhere.joints, frame="tip", force=True).positions - truth
        left[name] = np.sqrt((error**2).sum(axis=1).mean())
    assert left["corrected"] < 0.5 * left["geometry"]
    assert "gravity sag of the links" in found.export("c")


def test_size_is_the_sag_of_the_flange(sagging):
    for effect in (LinkSag(size=0.3), dataclasses.replace(KNOWN, size=0.3)):
        bound = bind(Problem(ROBOT, TRACKER, terms=(effect,)), sagging)
        own = [j for j, key in enumerate(bound.beside) if key == "give"]
        rng, x0 = np.random.default_rng(0), bound.x0
        joints = rng.uniform(-np.pi, np.pi, (300, 6))
        sags = []
        for _ in range(40):
            x = x0.copy()
            x[own] += rng.normal(size=len(own)) * bound.prior_std[own]
            sags.append(bound.tips(x, joints)[:, 2] - bound.tips(x0, joints)[:, 2])
        assert 0.2 < np.sqrt(np.mean(np.square(sags))) < 0.5


def test_a_controller_s_conventions_change_nothing(sagging):
    conventions = Conventions((1, 1, 1, 1, -1, 1), (0.1, 0.0, 0.2, 0.0, 0.0, 0.0), coupling=((3, 2, -1.0),))
    alpha, a, d = TABLE
    arm = Robot.from_dh("UR5", alpha=alpha, a=a, d=d, theta=(0.0,) * 6, parallel=(2, 3), conventions=conventions)
    same = dataclasses.replace(sagging, joints=conventions.to_controller(sagging.joints))
    plain = Robot.from_dh("UR5", alpha=alpha, a=a, d=d, theta=(0.0,) * 6, parallel=(2, 3))
    one, two = (bind(Problem(robot, TRACKER, terms=(KNOWN,)), rows) for robot, rows in ((plain, sagging), (arm, same)))
    x = one.x0.copy()
    own = [j for j, key in enumerate(one.beside) if key == "give"]
    x[own] = GIVE[1:]
    assert np.abs(one.residual(x) - two.residual(x)).max() < 1e-7


def test_gravity_may_point_elsewhere(sagging):
    wall = dataclasses.replace(KNOWN, down=(2.0, 0.0, 0.0))
    bound = bind(Problem(ROBOT, TRACKER, terms=(wall,)), sagging)
    own = [j for j, key in enumerate(bound.beside) if key == "give"]
    assert len(own) == 6, "about an axis that lies, weights turn the first joint too"
    x, give = bound.x0.copy(), 1e-5 * np.arange(1, 7)
    x[own] = give
    off = np.array([give * moments(q, (1.0, 0.0, 0.0)) for q in sagging.joints])
    expected = flanges(sagging.joints + off)[:, :3] @ np.array([*TOOL, 1.0])
    assert np.allclose(bound.tips(x, sagging.joints), expected, atol=1e-5)


URDF = """<robot name="two">
  <link name="base"><inertial><mass value="99"/></inertial></link>
  <link name="upper"><inertial><origin xyz="0.2 0 0.01"/><mass value="4"/></inertial></link>
  <link name="cover"><inertial><origin xyz="0 0 0.1"/><mass value="1"/></inertial></link>
  <link name="lower"><inertial><mass value="2"/></inertial></link>
  <link name="tool"/>
  <joint name="j1" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.3"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3"/></joint>
  <joint name="glue" type="fixed"><parent link="upper"/><child link="cover"/>
    <origin xyz="0.1 0 0" rpy="0 1.5707963267948966 0"/></joint>
  <joint name="j2" type="revolute"><parent link="upper"/><child link="lower"/><origin xyz="0.5 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3"/></joint>
  <joint name="end" type="fixed"><parent link="lower"/><child link="tool"/><origin xyz="0.4 0 0"/></joint>
</robot>"""


def test_masses_come_from_a_urdf(tmp_path):
    path = tmp_path / "two.urdf"
    path.write_text(URDF)
    found = LinkSag.from_urdf(path, tip="tool", payload=3.0)
    assert found.masses == (5.0, 5.0)
    upper = (4 * np.array([200.0, 0, 310]) + 1 * np.array([200.0, 0, 300])) / 5  # the cover's z axis lies along x
    lower = (2 * np.array([500.0, 0, 300]) + 3 * np.array([900.0, 0, 300])) / 5
    assert np.allclose(found.centres, [upper, lower])
    assert LinkSag.from_urdf(path, tip="tool").masses == (5.0, 2.0)
    robot = Robot.from_urdf(path, tip="tool")
    problem = Problem(robot, TrackedPoint(noise_std=0.1), terms=(found,))
    assert problem.symbols.unknowns["give"].size == 2, "one give for each joint, both about axes that lie"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('<mass value="4"/>', '<mass value="heavy"/>', "the mass of link 'upper' is 'heavy'"),
        ('<mass value="4"/>', '<mass value="-4"/>', "the mass of link 'upper' is -4"),
        ('xyz="0.2 0 0.01"', 'xyz="0.2 0"', "the centre of mass of link 'upper' is '0.2 0'"),
        ('xyz="0.2 0 0.01"', 'xyz="0.2 0 nan"', "the centre of mass of link 'upper'"),
    ],
)
def test_weights_that_are_none_are_refused(tmp_path, old, new, said):
    path = tmp_path / "two.urdf"
    path.write_text(URDF.replace(old, new))
    with pytest.raises(ProblemError, match=said):
        LinkSag.from_urdf(path, tip="tool")


def test_an_arm_without_masses_is_said_to_be_one(tmp_path):
    path = tmp_path / "two.urdf"
    path.write_text(
        "".join(part for part in URDF.splitlines(keepends=True) if "<inertial>" not in part or "99" in part)
    )
    with pytest.raises(ProblemError):
        LinkSag.from_urdf(path, tip="tool")
    weightless = URDF
    for value in ("4", "1", "2"):
        weightless = weightless.replace(f'<mass value="{value}"/>', '<mass value="0"/>')
    path.write_text(weightless)
    with pytest.raises(ProblemError, match="no link of the arm has a mass"):
        LinkSag.from_urdf(path, tip="tool")
    for payload in (-1.0, float("nan")):
        with pytest.raises(ProblemError, match="payload"):
            LinkSag.from_urdf(path, tip="tool", payload=payload)


def test_what_does_not_fit_the_arm_is_said(sagging):
    for effect, said in (
        (LinkSag(masses=(1.0, 2.0)), "Got 2 masses for 6 joints"),
        (LinkSag(masses=MASSES, centres=AT_ZERO[:3]), "Got 3 centres of mass for 6 joints"),
    ):
        with pytest.raises(ProblemError, match=said):
            bind(Problem(ROBOT, TRACKER, terms=(effect,)), sagging)
    for wrong, said in (
        ({"masses": (1.0, -2.0)}, "Got -2.0 as the mass of a link"),
        ({"masses": (0.0, 0.0)}, "The links weigh nothing"),
        ({"masses": ("a",)}, "Got 'a' as the mass of a link"),
        ({"masses": (1e300,) * 6}, "Give kilograms"),
        ({"masses": None}, "Got None as the mass of a link"),
        ({"masses": MASSES, "centres": ((1, 2),)}, "as a centre of mass"),
        ({"masses": MASSES, "centres": 5}, "as a centre of mass"),
        ({"centres": AT_ZERO}, "Centres of mass came without masses"),
    ):
        with pytest.raises(ProblemError, match=said):
            LinkSag(**wrong)
    with pytest.raises(ProblemError, match="Gravity"):
        LinkSag(down=(0, 0, 0))

    def crossed(p, q):
        return ROBOT.pose(p, [q[j] for j in (0, 2, 1, 3, 4, 5)])

    odd = Robot("crossed", 6, crossed, ROBOT.parameters)
    with pytest.raises(ProblemError, match="do not carry one another in order"):
        bind(Problem(odd, TRACKER, terms=(LinkSag(),)), sagging)


def test_an_upright_scara_carries_nothing():
    table = {"alpha": (0.0,) * 3, "a": (300.0, 250.0, 0.0), "d": (400.0, 0.0, 0.0), "theta": (0.0,) * 3}
    scara = Robot.from_dh("SCARA", **table, joints="RRP")
    effect = LinkSag()
    problem = Problem(scara, TrackedPoint(noise_std=0.1, tool=Parameter((0.0, 0.0, 10.0))), terms=(effect,))
    samples = simulate(problem.without_terms, samples=20, seed=0).samples
    assert "give" not in bind(problem, samples).beside


@pytest.mark.long
def test_it_takes_the_place_of_the_simpler_sag(sagging):
    """Beside it, both shared the sag between them, and one of them was not corrected: two to three times as bad."""
    kit = with_kit(Problem(ROBOT, TRACKER))
    with_links = kit.with_terms(*kit.terms, KNOWN)
    assert [effect for effect in with_links.terms if effect.key == "give"] == [KNOWN]
    assert len(with_links.terms) == len(kit.terms)
    found = calibrate(with_links, sagging, reference=False)
    plain = calibrate(Problem(ROBOT, TRACKER), sagging, reference=False)
    assert "give" in found.corrected
    assert found.tip_std[1] < 1.02 * plain.tip_std[1]


@pytest.mark.long
@pytest.mark.parametrize(("weights", "tells"), [(True, LinkSag), (False, GravitySag)])
def test_whose_weight_bends_an_arm_is_told_by_the_rows(weights, tells):
    """Of an arm that nobody described: all links weigh, or one weight hangs at the flange."""
    source = load_problem(ROOT / "problems" / "ur5")
    if weights:
        made = simulate(source.problem, source.cell, samples=120, seed=2)
        off = np.array([SOFT * moments(q) for q in made.samples.joints])
        rows = dataclasses.replace(made.samples, joints=made.samples.joints - off)
    else:
        made = simulate(source.problem, dataclasses.replace(source.cell, compliance=0.3), samples=120, seed=2)
        rows = made.samples
    found = calibrate(source.problem, rows, reference=False)
    assert found.corrected == ("give",)
    assert [type(each) for each in found.fit.problem.terms if each.key == "give"] == [tells]
    joints = workspace_joints(ROBOT)
    true = made.true_tips(joints)
    shown = joints - np.array([SOFT * moments(q) for q in joints]) if weights else joints
    error = tip_rms(without_rigid((found.predict(shown, frame="tip").positions - true).ravel(), true))
    alone = calibrate(source.problem, rows, discrepancy="none", reference=False)
    left = alone.predict(shown, frame="tip").positions - true
    assert error < 1.6 * found.tip_std[1]
    assert error < 0.5 * tip_rms(without_rigid(left.ravel(), true))
    again = load_saved(found)
    given = load_saved(found, problem=source.problem)  # which declares no effects
    np.testing.assert_array_equal(
        given.predict(shown, frame="tip").positions, found.predict(shown, frame="tip").positions
    )
    np.testing.assert_array_equal(
        again.predict(shown, frame="tip", std=True).std, found.predict(shown, frame="tip", std=True).std
    )


def load_saved(found, problem=None):
    """The same from what result.json would hold."""
    with tempfile.TemporaryDirectory() as folder:
        found.save(folder + "/made")
        return load(folder + "/made", problem=problem)
