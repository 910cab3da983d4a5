"""A 15-line instrument of a user's own goes through every command and every function, also with all unknowns held."""

import json
import math
import sys
from dataclasses import replace
from types import ModuleType
from typing import ClassVar

import casadi as ca
import numpy as np
import pandas as pd
import pytest
from conftest import ROOT
from own_instrument import SOURCES, written
from scipy.spatial.transform import Rotation

from casacal import (
    CasacalError,
    Instrument,
    Parameter,
    Plane,
    Problem,
    Samples,
    bind,
    calibrate,
    check,
    load,
    load_problem,
    simulate,
)
from casacal.calibration.verdict import verdict_of
from casacal.cli.main import main
from casacal.deployment.as_data import problem_data, problem_from
from casacal.errors import ProblemError, SimulationError
from casacal.fit.methods import METHODS
from casacal.model.kinematics import position, rotation
from casacal.simulation import Disturbances


@pytest.fixture(scope="module", params=SOURCES)
def place(request, tmp_path_factory):
    return written(tmp_path_factory.mktemp("own"), request.param)


@pytest.fixture(scope="module")
def samples(place):
    assert main(["simulate", str(place), "--out", str(place / "samples.csv"), "--samples", "70", "--seed", "4"]) == 0
    return place / "samples.csv"


def test_simulated_rows_fit_their_own_truth(place, samples):
    """The truth explains the rows to their noise: what was simulated is what the residual says."""
    source = load_problem(place)
    simulated = simulate(source.problem, Disturbances(resolution=0.0), samples=70, seed=4)
    bound = bind(source.problem, simulated.samples)
    size = np.sqrt(np.mean(bound.residual(simulated.truth(bound)) ** 2))
    assert 0.75 < size < 1.25
    written_down = source.problem.read(samples)
    np.testing.assert_allclose(written_down.joints, simulated.samples.joints, atol=2e-8)
    truth = load(samples.with_suffix(".truth.json"))
    assert truth.arm.document["method"] == "truth"


def test_without_noise_the_truth_is_exact(place):
    source = load_problem(place)
    still = Disturbances(resolution=0.0, repeatability=0.0, error_scale=2.0)
    simulated = simulate(source.problem, still, samples=60, seed=9)
    exact = bind(source.problem, simulated.samples)
    if not source.problem.instrument.column_stds:
        assert np.abs(exact.plain_residual(simulated.truth(exact))).max() < 1e-5
    again = simulate(source.problem, still, samples=60, seed=9)
    assert again.samples == simulated.samples
    assert simulate(source.problem, still, samples=60, seed=8).samples != simulated.samples
    lower, upper = source.problem.robot.limits
    assert ((simulated.samples.joints >= lower) & (simulated.samples.joints <= upper)).all()


@pytest.mark.long_unless("held-lm")
@pytest.mark.parametrize(
    ("place", "method"),
    [*(("wire", method) for method in METHODS), ("stylus", "lm"), ("held", "lm")],
    indirect=["place"],
)
def test_each_method_calibrates_and_reports(place, samples, method, tmp_path, capsys):
    code = main(["calibrate", str(place), str(samples), "--method", method, "--holdout", "0.2", "--out", str(tmp_path)])
    said = capsys.readouterr()
    assert code in (0, 1), said.err
    assert "Traceback" not in said.err
    document = json.loads((tmp_path / "result.json").read_text())
    assert document["converged"]
    assert set(document["metrics"]["after"]["fit"]) == {"rmse_mm", "mae_mm", "std_mm", "max_mm"}
    page = (tmp_path / "report.html").read_text()
    assert "planes fitted alone" not in page
    assert "distance from the planes" not in page.lower()


@pytest.mark.long_unless("wire")
def test_check_predict_compensate_and_export(place, samples, tmp_path, capsys):
    assert main(["check", str(place), str(samples)]) in (0, 1)
    assert main(["calibrate", str(place), str(samples), "--method", "lm", "--out", str(tmp_path)]) in (0, 1)
    result = str(tmp_path / "result.json")
    for frame in ("flange", "tip"):
        out = tmp_path / f"{frame}.csv"
        assert main(["predict", result, str(samples), "--frame", frame, "--std", "--out", str(out)]) == 0
        assert np.isfinite(pd.read_csv(out, comment="#").to_numpy()).all()
    targets = tmp_path / "targets.csv"
    joints = load_problem(place).problem.robot.revolute.size
    targets.write_text(
        ",".join(f"q{i + 1}_deg" for i in range(joints))
        + "\n"
        + ",".join(["20", "-30", "40", "10", "25", "5"][:joints])
    )
    assert main(["compensate", result, str(targets), "--out", str(tmp_path / "c.csv")]) == 0
    for form in ("dh", "zeros", "c"):
        assert main(["export", result, "--to", form, "--out", str(tmp_path / f"arm.{form}")]) == 0
    capsys.readouterr()


def test_the_estimate_is_nearer_to_the_truth_than_the_drawing(tmp_path):
    """By the wire alone the arm's tip becomes right; judged by the simulated truth."""
    source = load_problem(written(tmp_path, "wire"))
    simulated = simulate(source.problem, samples=120, seed=2)
    found = calibrate(source, simulated.samples)
    truth = simulated.truth(found.fit)
    joints = found.workspace[0]
    true, now, drawn = (found.fit.tips(x, joints) for x in (truth, found.x, found.fit.x0))
    # a wire to one post cannot tell where the base stands
    assert apart_from_the_base(now, true) < 0.1 * apart_from_the_base(drawn, true)


def apart_from_the_base(tips, true):
    """RMS distance (mm) of tips from where they should be after the best shift and turn of all."""
    one, two = tips - tips.mean(axis=0), true - true.mean(axis=0)
    turn, _ = Rotation.align_vectors(two, one)
    return np.sqrt(((turn.apply(one) - two) ** 2).sum(axis=1).mean())


def test_touches_stay_on_the_faces_of_a_cell(tmp_path):
    from casacal import Cell, corner

    source = load_problem(written(tmp_path, "stylus"))
    cell = Cell(faces=corner((550.0, 0.0, 350.0), size=300.0))
    simulated = simulate(source.problem, cell, samples=30, seed=1)
    assert simulated.samples.labels["face"].names == ("floor", "wall", "side")
    bound = bind(source.problem, simulated.samples)
    tips = bound.tips(simulated.truth(bound), simulated.samples.joints)
    for face in cell.faces:
        here = tips[np.array(simulated.samples.labels["face"]) == face.label] - np.array(face.centre)
        assert np.abs(here @ face.axes[0]).max() < 6 * 0.02
        assert np.abs(here @ face.axes[1:].T).max() < 150.0 + 1e-6


def test_what_means_nothing_to_an_instrument_is_refused(place, tmp_path, capsys):
    for option in (["--tilt", "10"], ["--flatness", "0.01"], ["--travel", "5"]):
        assert main(["simulate", str(place), "--out", str(tmp_path / "s.csv"), *option]) == 2
        assert "touches none" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_a_drawing_that_fits_is_no_calibration(tmp_path):
    source = load_problem(written(tmp_path, "held"))
    found = calibrate(source, simulate(source.problem, samples=50, seed=1).samples)
    verdict = verdict_of(found)
    assert verdict.level == "use with care"
    assert "nothing was estimated" in verdict.words
    assert "tip error" not in verdict.words


@pytest.mark.long
def test_every_unknown_held_says_that_nothing_was_estimated(hsr, tmp_path, capsys):
    names = "alpha,a,d,theta,plane"
    for method in METHODS:
        found = calibrate(hsr.problem.fix(*names.split(",")), hsr.problem.read(hsr.samples), method=method)
        assert found.fit.unknowns == 0
        assert found.result.method == method
        assert "nothing was estimated" in found.message
        assert math.isfinite(found.cost)
        if method == "swarm":  # the verdict of all is that of the arm as drawn, and takes many fits
            verdict = verdict_of(found)
            assert verdict.level == "do not use"  # it misses its planes by far
            assert "tip error" not in verdict.words
            assert "is held where" not in verdict.words  # no arm was fitted to anything
            assert found.summary()
    assert main(["calibrate", str(hsr.path), "--fix", names, "--out", str(tmp_path)]) in (0, 1)
    assert json.loads((tmp_path / "result.json").read_text())["identifiability"]["unknowns"] == 0
    capsys.readouterr()


def refuse(what, fix):
    raise ProblemError(what, fix)


@pytest.mark.parametrize(
    ("gives", "says"),
    [
        (lambda: (1.0, 2.0), r"`propose` of Wire gave 1\.0, 2\.0 for 'post'\. Give 3 finite numbers"),
        (lambda: (1.0, 2.0, math.nan), r"gave 1\.0, 2\.0, nan for 'post'"),
        (lambda: "here", r"`propose` of Wire failed for 'post': ValueError: .*Mend it, or leave it out"),
        (lambda: 1 / 0, r"failed for 'post': ZeroDivisionError: division by zero"),
        (lambda: refuse("Too few posts", "Take more"), "^Too few posts. Take more.$"),
    ],
)
def test_a_proposal_that_is_none_is_refused_by_name(tmp_path, gives, says):
    problem = load_problem(written(tmp_path, "wire")).problem
    samples = simulate(problem, samples=40, seed=0).samples
    kind = type(problem.instrument)

    class Wire(kind):
        unknowns: ClassVar = {**problem.instrument.unknowns, "post": Parameter(None, labels=("_x", "_y", "_z"))}

        def propose(self, key, sight):
            return gives()

    with pytest.raises(ProblemError, match=says):
        bind(Problem(problem.robot, Wire()), samples)


@pytest.mark.long
def test_planes_may_be_held_where_they_are_proposed(hsr, capsys):
    held = calibrate(hsr.problem.fix("plane"), hsr.problem.read(hsr.samples), method="lm")
    assert held.bare.unknowns == 24
    assert held.reference.agrees
    free = calibrate(hsr.problem, hsr.problem.read(hsr.samples), method="lm")
    assert free.cost < held.cost
    assert main(["calibrate", str(hsr.path), "--fix", "plane", "--method", "lm"]) in (0, 1)
    assert "Traceback" not in capsys.readouterr().err


def test_samples_of_one_are_refused_for_two_instruments_in_a_sentence(hsr, corner_simulation):
    from casacal import Problem, TrackedPoint

    both = Problem(hsr.problem.robot, hsr.problem.instrument, TrackedPoint(noise_std=0.1))
    for call, said in (
        (lambda: calibrate(both, corner_simulation.samples), "as samples of 2 instruments"),
        (lambda: check(both, corner_simulation.samples), "not those of the problem's instruments"),
        (lambda: simulate(both, samples=6).samples, "measured by 2 instruments"),
    ):
        with pytest.raises(CasacalError, match=said):
            call()


def test_a_problem_file_leaves_no_module_behind(tmp_path):
    before = set(sys.modules)
    path = list(sys.path)
    one, two = written(tmp_path / "a", "wire"), written(tmp_path / "b", "wire")
    (two / "anchors.py").write_text("POST = (999.0, 0.0, 200.0)\n")
    posts = [load_problem(place).problem.instrument.unknowns["post"].values[0] for place in (one, two, one)]
    assert posts == [1500.0, 999.0, 1500.0]
    assert "anchors" not in sys.modules
    assert set(sys.modules) - before <= {name for name in sys.modules if name.startswith("casacal.")}
    assert sys.path == path


def test_a_module_of_the_same_name_elsewhere_is_neither_used_nor_lost(tmp_path, monkeypatch):
    """The user's own program may have imported another `anchors` long before."""
    mine = ModuleType("anchors")
    mine.POST = (1.0, 2.0, 3.0)
    monkeypatch.setitem(sys.modules, "anchors", mine)
    place = written(tmp_path, "wire")
    assert load_problem(place).problem.instrument.unknowns["post"].values[0] == 1500.0
    assert sys.modules["anchors"] is mine


def test_the_datum_is_what_nobody_knew_beforehand(hsr):
    """By default the control M0 fits unknowns with flat priors: not those that are held or known to a tolerance."""

    class Some(Instrument):
        residual_std = 0.1
        unknowns = {  # noqa: RUF012
            "face": Plane((0, 0, 1), (0, 0, 5)),
            "held": Plane((0, 0, 1), (0, 0, 5), free=False),
            "known": Parameter(3.0, prior_std=0.1),
            "partly": Plane((0, 0, 1), (0, 0, 5), prior_std=(1e-3, math.inf)),
        }

        def residual(self, pose, p, row):
            return p.face.distance(pose[:3, 3]) + p.known + p.partly.offset + p.held.offset

    assert Some().datum == ("face",)
    assert Some().words.before == "face fitted alone"


def test_a_problem_file_may_load_another_one(tmp_path):
    """With a module of the same name beside each: every file sees its own."""
    inner, outer = written(tmp_path / "in", "wire"), tmp_path / "out"
    outer.mkdir()
    (outer / "anchors.py").write_text("POST = 'mine'\n")
    (outer / "problem.py").write_text(
        f"from anchors import POST\nfrom casacal import load_problem\n"
        f"problem = load_problem({str(inner)!r}).problem.fix('post')\n"
        "from anchors import POST as again\nassert POST == again == 'mine'\n"
    )
    assert load_problem(outer).problem == load_problem(inner).problem.fix("post")


@pytest.mark.long
def test_unknowns_of_the_smallest_instrument_can_be_held_and_given_priors(tmp_path, capsys):
    place = written(tmp_path, "wire")
    source = load_problem(place)
    assert bind_count(source.problem) == 12 + 3
    assert bind_count(source.problem.fix("post")) == 12
    assert bind_count(source.problem.fix("post2")) == 12 + 2
    tight = source.problem.with_prior({"post": 0.25})
    assert tight.instrument.unknowns["post"].prior_stds.tolist() == [0.25] * 3
    assert source.problem.instrument.unknowns["post"].prior_stds.tolist() == [5.0] * 3
    assert main(["simulate", str(place), "--out", str(place / "samples.csv"), "--samples", "60"]) == 0
    assert main(["calibrate", str(place), "--fix", "post", "--prior", "a=0.1", "--method", "lm"]) in (0, 1)
    capsys.readouterr()


def bind_count(problem):
    return bind(problem, simulate(problem, samples=40, seed=0).samples).unknowns


@pytest.mark.parametrize(
    ("changed", "says"),
    [
        (('{"wire": "length"}', '{"wire": "lenght"}'), "'wire' of DrawWire is a 'lenght'. Known: length, angle"),
        (('column_stds = {"wire"', 'column_stds = {"wires"'), "names 'wires', which is no column"),
        (('column_stds = {"wire": ', 'reading_limits = {"wires": (0, 9)}; column_stds = {"wire": '), "names 'wires'"),
        (('column_stds = {"wire": ', 'begins_at = {"wires": 9.0}; column_stds = {"wire": '), "names 'wires'"),
        (('column_stds = {"wire": ', 'reading_limits = (0, 9); column_stds = {"wire": '), "limits of DrawWire is"),
        (('columns = {"wire": "length"}', 'columns = ["wire"]'), "columns of DrawWire is a list"),
        (('{"post": Parameter(POST, prior_std=5.0)}', '{"post": 3.0}'), "'post' of DrawWire is a float"),
        (("**ARM), DrawWire())", "**ARM), DrawWire)"), "Got the class DrawWire"),
        (("**ARM), DrawWire())", "**ARM), [DrawWire()])"), "Got a list as an instrument"),
        (("- p.post)", "- p.pots)"), "problem.py, line 15: residual of 'DrawWire' failed with AttributeError"),
        (
            (
                "    def residual",
                "    def plunger_direction(self, pose, p):\n        return p.axis\n\n    def residual",
            ),
            "problem.py, line 15: plunger_direction of 'DrawWire' failed with AttributeError",
        ),
        (
            (
                "    def residual",
                "    def plunger_direction(self, pose, p):\n        return pose[:2, 2]\n\n    def residual",
            ),
            "plunger_direction of 'DrawWire' has the shape (2, 1). It must be (3, 1)",
        ),
        ((" - row.wire", ""), "does not depend on what it reads, its column 'wire'"),
        (
            ('problem = Problem(Robot.from_dh("small", **ARM), DrawWire())', 'problem = "x"'),
            "as a Problem, but a str",
        ),
    ],
)
def test_a_slip_in_an_own_instrument_is_one_line(tmp_path, capsys, changed, says):
    place = written(tmp_path, "wire")
    text = (place / "problem.py").read_text()
    assert changed[0] in text
    (place / "problem.py").write_text(text.replace(*changed))
    assert main(["simulate", str(place), "--out", str(tmp_path / "s.csv")]) == 2
    said = capsys.readouterr().err
    assert says in said
    assert len(said.splitlines()) == 1


LIMITS = {"range": (0.0, 3000.0)}


def laser(**declared):
    """A laser on the flange that looks at walls; a line of numbers alone says how far it is from one."""

    class Laser(Instrument):
        residual_std = 0.05

        def residual(self, pose, p, row):
            return p.wall.distance(position(pose) + row.range * rotation(pose)[:, 2])

    walls = {"wall": Plane((1, 0, 0), (2500, 0, 0), per="wall")}
    for name, value in {"columns": {"range": "length"}, "unknowns": walls, **declared}.items():
        setattr(Laser, name, value)
    return Problem(load_problem(ROOT / "problems" / "hsr_jr680").problem.robot, Laser())


def test_simulated_readings_keep_to_what_a_device_can_show():
    free = simulate(laser(), Disturbances(resolution=0.0), samples=60, seed=1).samples.columns["range"]
    kept = simulate(laser(reading_limits=LIMITS), Disturbances(resolution=0.0), samples=60, seed=1).samples
    assert (free < 0).mean() > 0.2
    assert 0 < kept.columns["range"].min() < kept.columns["range"].max() < 3000
    with pytest.raises(SimulationError, match=r"inside the limits of .* and its readings"):
        simulate(laser(reading_limits={"range": (-2.0, -1.0)}), samples=5, seed=1)
    with pytest.raises(SimulationError, match=r"without its reading_limits \('range' -2 to -1\) more do. Widen"):
        simulate(laser(reading_limits={"range": (-2.0, -1.0)}), samples=5, seed=1)


class Impossible(Instrument):
    """A residual that no posture and no reading makes vanish, beside limits that are not to blame."""

    columns: ClassVar = {"range": "length"}
    reading_limits: ClassVar = {"range": (0.0, 3000.0)}
    residual_std = 0.1

    def residual(self, pose, p, row):
        return 1.0 + ca.sumsqr(position(pose)) / 1e6 + (row.range / 1000) ** 2


def test_limits_that_are_not_to_blame_are_not_named():
    robot = load_problem(ROOT / "problems" / "hsr_jr680").problem.robot
    with pytest.raises(SimulationError, match="Give its unknowns nominal values within the arm's reach") as refused:
        simulate(Problem(robot, Impossible()), samples=3, seed=1)
    assert "reading_limits" not in str(refused.value)


class HeightGauge(Instrument):
    """A gauge on a plate reads how high the tip stands above it; its column is called like the height of a step."""

    columns: ClassVar = {"height": "length"}
    column_stds: ClassVar = {"height": 0.01}
    reading_limits: ClassVar = {"height": (0.0, 300.0)}
    unknowns: ClassVar = {"plate": Plane(per="plate")}

    def residual(self, pose, p, row):
        return p.plate.distance(position(pose)) - row.height

    def propose(self, key, sight):
        return sight.touched_plane()


def test_a_reading_called_height_is_no_known_height():
    """A reading was once taken off as if it were a step's height, in what a folder of a result had kept."""
    problem = Problem(load_problem(ROOT / "problems" / "hsr_jr680").problem.robot, HeightGauge())
    rng = np.random.default_rng(3)
    joints = rng.uniform(-0.5, 0.5, (40, 6))
    columns = {f"q{k}_rad": joints[:, k - 1] for k in range(1, 7)}
    columns |= {"height_mm": rng.uniform(0, 300, 40), "plate": ["a"] * 40}
    rows = Samples.from_arrays(columns, problem.layout())
    kept = problem_from(problem_data(problem))
    assert type(kept.instrument).__name__ == "TracedInstrument"
    np.testing.assert_allclose(bind(kept, rows).x0, bind(problem, rows).x0)


class CrossTable(Instrument):
    """A ball on the flange over a table with two scales, and an encoder at the table's pivot."""

    columns: ClassVar = {"x": "length", "y": "length", "turn": "angle"}
    column_stds: ClassVar = {"x": 0.01, "y": 0.01, "turn": 1e-4}
    reading_limits: ClassVar = {"turn": (0.0, 6.0)}
    unknowns: ClassVar = {"pivot": Parameter((-2000.0, -2000.0), prior_std=5.0)}

    def residual(self, pose, p, row):
        at = position(pose)
        turn = ca.atan2(at[1] - p.pivot[1], at[0] - p.pivot[0])
        return ca.vertcat(at[0] - row.x, at[1] - row.y, 1000 * (turn - row.turn))


@pytest.mark.long_unless("<lambda>-sign of 'turn'", "<lambda>-'x' and 'y' swapped")
@pytest.mark.parametrize(
    ("wrong", "about"),
    [
        (lambda read: {**read, "x": -read["x"]}, "sign of 'x'"),
        (lambda read: {**read, "turn": -read["turn"]}, "sign of 'turn'"),
        (lambda read: {**read, "x": read["y"], "y": read["x"]}, "'x' and 'y' swapped"),
        (lambda read: {**read, "turn": np.degrees(read["turn"])}, "unit of the angles"),
    ],
)
def test_mistakes_in_each_column_of_ones_own_instrument_are_named(wrong, about):
    problem = Problem(load_problem(ROOT / "problems" / "hsr_jr680").problem.robot, CrossTable())
    rows = simulate(problem, Disturbances(resolution=0.0), samples=80, seed=1).samples
    assert not check(problem, rows)
    assert [found.about for found in check(problem, replace(rows, columns=wrong(rows.columns)))] == [about]


def test_check_claims_no_mistake_that_it_did_not_try_and_names_readings_out_of_limits():
    class Untried(CrossTable):
        suspects: ClassVar = ()

    problem = Problem(load_problem(ROOT / "problems" / "hsr_jr680").problem.robot, Untried())
    read = simulate(problem, Disturbances(resolution=0.0), samples=80, seed=1).samples
    (found,) = check(problem, replace(read, columns={**read.columns, "x": -read.columns["x"]}))
    assert "no swapped joints or coupling explains it" in found.cause
    limits, _ = check(problem, replace(read, columns={**read.columns, "turn": -read.columns["turn"]}))
    assert (limits.severity, limits.about) == ("error", "readings outside limits")
    assert "Reverse the sign of column 'turn'" in limits.fix


@pytest.mark.long_unless("-1.0-sign of the lengths-Reverse the sign")
@pytest.mark.parametrize(
    ("factor", "about", "says"),
    [(-1.0, "sign of the lengths", "Reverse the sign"), (1.01, "scale of the readings", "by +1.0")],
)
def test_sign_and_scale_of_ones_own_instrument_are_named(factor, about, says):
    problem = laser(reading_limits=LIMITS)
    rows = simulate(problem, Disturbances(resolution=0.0), samples=120, seed=1).samples
    assert not check(problem, rows, confirmed=True)
    wrong = replace(rows, columns={"range": factor * rows.columns["range"]})
    (found,) = check(problem, wrong)
    assert (found.severity, found.about) == ("error", about)
    assert says in str(found)
