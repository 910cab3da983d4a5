"""The reference by any of CasADi's nonlinear solvers: the same minimum, honest failures, refusals in a sentence."""

import json
import pickle
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from linear import Matrix, as_symbols, random_linear
from oracles import posterior

from casacal import CasacalError, calibrate, huber, lm
from casacal.cli.main import main
from casacal.errors import ProblemError
from casacal.fit import Status, nlpsol
from casacal.fit.ipopt import Objective, _program
from casacal.simulation import Simulated
from casacal.study import Method, Study
from casacal.study.trial import Task, perform

SOLVERS = [
    pytest.param(name, marks=pytest.mark.skipif(not ca.has_nlpsol(name), reason=f"this CasADi has no {name}"))
    for name in ("ipopt", "fatrop", "sqpmethod", "uno")
]


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solver_finds_the_closed_form(solver):
    a, y, nominal, prior, noise = random_linear(3)
    mean, _ = posterior(a / noise, y / noise, nominal, prior)
    result = nlpsol(as_symbols(a, y, nominal, prior, noise), solver=solver)
    assert (result.method, result.converged) == (solver, True)
    np.testing.assert_allclose(result.x + nominal, mean, atol=1e-7)


@pytest.mark.parametrize(
    ("solver", "options", "named"),
    [
        ("ipopt", {"ipopt.max_itr": 3}, "No such IPOPT option: max_itr"),
        ("ipopt", {"max_itr": 3}, "Unknown option: max_itr"),
        ("sqpmethod", {"max_itr": 3}, "Unknown option: max_itr"),
    ],
)
def test_an_option_that_a_solver_does_not_know_is_named(solver, options, named):
    with pytest.raises(CasacalError, match=named):
        nlpsol(as_symbols(*random_linear(3)), solver=solver, options=options)


@pytest.mark.parametrize("solver", SOLVERS)
def test_every_solver_finds_the_minimum_of_lm_and_says_nothing(solver, corner_bound, capfd):
    mine, theirs = lm(corner_bound), nlpsol(corner_bound, solver=solver)
    assert theirs.converged
    assert theirs.cost == pytest.approx(mine.cost, rel=1e-9)
    np.testing.assert_allclose((theirs.x - mine.x) / mine.std, 0, atol=1e-4)
    assert theirs.trace["cost"][-1] == pytest.approx(theirs.cost, rel=1e-9)
    assert theirs.residual_rows > corner_bound.rows
    assert "".join(capfd.readouterr()) == ""


def test_the_derivatives_that_solvers_ask_for_are_those_of_the_objective(corner_bound):
    """What CasADi derives of the program, against differences of the objective's value and gradient."""
    objective = Objective(corner_bound.graph, corner_bound)
    program, _, kept = _program(corner_bound.graph, objective, exact=False)
    hessian, gradient = ca.hessian(program["f"], program["x"])
    made = ca.Function("made", [program["x"]], [program["f"], gradient, hessian])
    y, n = 0.1 * np.random.default_rng(0).normal(size=program["x"].numel()), program["x"].numel()
    value, slope, bend = (np.array(each) for each in made(y))
    for j in range(n):
        e = 1e-5 * np.eye(n)[j]
        (up, up_slope, _), (down, down_slope, _) = objective(y + e), objective(y - e)
        assert slope[j, 0] == pytest.approx((up - down) / 2e-5, rel=1e-5, abs=1e-5 * np.abs(slope).max())
        np.testing.assert_allclose(bend[:, j], (up_slope - down_slope) / 2e-5, atol=1e-5 * np.abs(bend).max())
    assert float(value[0, 0]) == objective(y)[0]
    assert len(kept) == 3


def test_options_reach_the_plug_in(corner_bound):
    quiet = {"print_header": False, "print_iteration": False, "print_status": False, "qpsol": "qrqp"}
    options = {**quiet, "qpsol_options": {"print_iter": False, "print_header": False}, "max_iter": 1}
    assert nlpsol(corner_bound, solver="sqpmethod", options=options).status is Status.MAX_STEPS


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"solver": "fatrob"}, "There is no nlpsol plug-in named 'fatrob'. Did you mean 'fatrop'? Known: "),
        ({"solver": "knitro"}, "There is no nlpsol plug-in named 'knitro'. Known: "),
        ({"solver": 3}, "Got an int as a solver"),
        ({"solver": "scpgen"}, "The solver 'scpgen' does not take this program: 'qpsol' option has not been set. Give"),
        ({"options": ["a"]}, "Got a list as the options of 'ipopt'. Give a dict"),
        ({"solver": "sqpmethod", "options": {"nonsense": 1}}, "The solver 'sqpmethod' does not take this program: "),
    ],
)
def test_what_is_no_solver_gets_a_sentence(corner_bound, given, says):
    with pytest.raises(CasacalError) as refused:
        nlpsol(corner_bound, **given)
    said = str(refused.value)
    assert said.startswith(says)
    assert "\n" not in said
    if "Known" in says:
        assert {"ipopt", "sqpmethod"} <= set(said.rpartition("Known: ")[2].rstrip(".").split(", "))
        assert "knitro" not in said.rpartition("Known: ")[2]


def test_a_matrix_has_no_program():
    a, y, nominal, prior, noise = random_linear(7)
    with pytest.raises(ProblemError, match="symbolic form"):
        nlpsol(Matrix(a / noise, y / noise, nominal, prior), solver="fatrop")


@pytest.mark.parametrize("solver", ["fatrop"])
def test_the_command_takes_it(solver, hsr, tmp_path, capsys):
    command = ["calibrate", str(hsr.path), "--discrepancy", "none", "--reference", solver, "--out", str(tmp_path)]
    assert main(command) == 0
    assert f"; {solver} agrees" in capsys.readouterr().out
    reference = json.loads((tmp_path / "result.json").read_text())["reference"]
    assert reference["solver"] == solver
    assert abs(reference["relative_gap"]) < 1e-8


@pytest.mark.skipif(not ca.has_nlpsol("bonmin"), reason="this CasADi has no bonmin")
def test_a_solver_that_prints_leaves_the_output_to_who_reads_it(hsr):
    words = ["calibrate", hsr.path, "--discrepancy", "none", "--reference", "bonmin", "--json"]
    done = subprocess.run([sys.executable, "-m", "casacal", *words], capture_output=True, text=True, check=False)
    assert json.loads(done.stdout)["reference"]["solver"] == "bonmin"
    assert "Cbc" in done.stderr


@pytest.mark.parametrize(
    ("options", "says"),
    [
        (["--reference", "knitro"], "There is no nlpsol plug-in named 'knitro'"),
        (["--reference", "ipopt", "--no-reference"], "Got --reference ipopt with --no-reference"),
    ],
)
def test_the_command_refuses_in_a_line(options, says, hsr, capsys):
    assert main(["calibrate", str(hsr.path), *options]) == 2
    out, err = capsys.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert says in err


def test_the_reference_is_never_the_method_itself(hsr):
    made = calibrate(hsr.problem, hsr.samples, method="ipopt", reference="ipopt", discrepancy="none")
    assert made.reference.solver == "lm"
    made = calibrate(hsr.problem, hsr.samples, method="ipopt", reference="fatrop", discrepancy="none")
    assert (made.reference.solver, made.reference.agrees) == ("fatrop", True)
    made = calibrate(hsr.problem, hsr.samples, loss=huber(), reference="fatrop")
    assert (made.reference.solver, made.reference.agrees) == ("fatrop", True)
    assert made.reference.result.loss == made.result.loss


def test_studies_take_it(hsr):
    methods = {name: Method(nlpsol, {"solver": name}) for name in ("fatrop", "sqpmethod")} | {"lm": lm}
    study = Study("tiny", {"cell": Simulated(hsr.problem, hsr.cell)}, methods, trials=1)
    study = pickle.loads(pickle.dumps(study))
    task = Task("cell", 0, tuple(methods), tuple(study.fingerprint("cell", name) for name in methods))
    records = perform(study, task)
    assert [record["error"] for record in records] == [None] * 3
    tips = [record["figures"]["tip_rms_mm"] for record in records]
    assert tips[0] == pytest.approx(tips[2], rel=1e-6)
    assert tips[1] == pytest.approx(tips[2], rel=1e-6)
    assert all(record["converged"] for record in records)
    assert records[0]["counts"]["residual_rows"] > 0


def test_effects_beside_the_geometry_are_in_the_program(hsr):
    fit = calibrate(hsr.problem, hsr.samples, reference=False).fit
    assert any(fit.beside)
    mine = lm(fit)
    for solver in ("fatrop", "sqpmethod"):
        assert nlpsol(fit, solver=solver).cost == pytest.approx(mine.cost, rel=1e-8)
