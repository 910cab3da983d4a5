"""Kernels: what C and blocks compute is what CasADi computes, with a compiler, without one, and with a spoilt cache."""

import logging
import math
import os
import shutil
import subprocess
import sys

import casadi as ca
import numpy as np
import pytest
from conftest import ROOT
from test_new_robots import scara

from casacal import DialOnPlane, Parameter, Problem, Robot, bind, calibrate, ekf, lm, load_problem, sckf, simulate
from casacal.effects import Backlash
from casacal.errors import ProblemError
from casacal.kernels import libraries, native_rows
from casacal.kernels.losses import huber
from casacal.kernels.native_rows import row_kernels
from casacal.kernels.program import NUMPY, C, evaluate, name_of, read_program

HAS_COMPILER = any(shutil.which(name) for name in ("gcc", "clang", "cc"))
BACKENDS = ["blocks", pytest.param("c", marks=pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler"))]


def bounds():
    """Problems of several shapes: six planes of a real arm, a slide, three residuals per row."""
    hsr = load_problem(ROOT / "problems" / "hsr_jr680")
    motoman = load_problem(ROOT / "problems" / "motoman_ma1400")
    scara_problem, scara_samples, _ = scara()
    return {
        "hsr": (hsr.problem, hsr.problem.read(hsr.samples), 2000.0),
        "motoman": (motoman.problem, simulate(motoman.problem, motoman.cell, seed=1).samples, 2000.0),
        "scara": (scara_problem, scara_samples, 600.0),
    }


@pytest.fixture(scope="module", params=["hsr", "motoman", "scara"])
def case(request):
    return bounds()[request.param]


def by_casadi(bound, x):
    """Plain residuals and whitened Jacobian by CasADi's own evaluation of the row's functions, row by row."""
    e, rows = [], []
    for block in bound.blocks:
        for k in range(len(block.data)):
            pattern = block.pattern[k]
            columns = block.columns[pattern]
            value, slopes = block.model.jacobian(x[columns], block.constants[pattern], block.data[k])
            value, slopes = np.array(value).ravel(), np.array(slopes).reshape(len(columns), -1, order="F").T
            for m in range(value.size):
                row = np.zeros(bound.unknowns)
                row[columns] = slopes[m] / block.noise[k, m]
                rows.append(row)
            e += value.tolist()
    return np.array(e), np.array(rows)


@pytest.mark.parametrize("backend", BACKENDS)
def test_kernels_compute_what_casadi_does(case, backend):
    problem, samples, reach = case
    bound = bind(problem, samples, backend=backend)
    assert bound.backend == backend
    noise = np.concatenate([block.noise.ravel() for block in bound.blocks])
    rng = np.random.default_rng(0)
    for x in (bound.x0, 0.5 * bound.start_std * rng.normal(size=bound.unknowns)):
        e, jacobian = by_casadi(bound, x)
        np.testing.assert_allclose(bound.plain_residual(x), e, rtol=0, atol=1e-12 * reach)
        scale = np.abs(jacobian).max()
        np.testing.assert_allclose(bound.jacobian(x), jacobian, rtol=0, atol=1e-12 * scale)
        normal, r = bound.normal(x), e / noise
        assert normal.cost == pytest.approx(r @ r / 2, rel=1e-12)
        np.testing.assert_allclose(normal.information, jacobian.T @ jacobian, rtol=0, atol=1e-12 * scale**2 * len(e))
        rounding = (np.abs(jacobian).T @ (1e-12 * reach / noise)).max()  # of the residuals, carried by the slopes
        np.testing.assert_allclose(normal.gradient, jacobian.T @ r, rtol=0, atol=rounding)
        np.testing.assert_array_equal(normal.information, normal.information.T)
    states = bound.x0 + 0.5 * bound.start_std * rng.normal(size=(7, bound.unknowns))
    expected = [np.sum((by_casadi(bound, x)[0] / noise) ** 2) / 2 + bound.prior_cost(x) for x in states]
    np.testing.assert_allclose(bound.costs(states), expected, rtol=1e-12)


@pytest.mark.parametrize("backend", BACKENDS)
def test_many_rows_go_over_many_blocks(hsr, backend):
    rows = hsr.problem.read(hsr.samples)
    for count in (1, 7, 128, 129, 700):
        chosen = np.random.default_rng(count).integers(len(rows), size=count)
        bound = bind(hsr.problem, rows, backend="blocks")
        x = 0.3 * bound.start_std
        other = bind(hsr.problem, rows, backend=backend).on(rows.take(chosen))
        np.testing.assert_allclose(other.residual(x), bound.residual(x)[chosen], rtol=1e-9, atol=1e-9)
        jacobian = bound.jacobian(x)[chosen]
        np.testing.assert_allclose(other.normal(x).information, jacobian.T @ jacobian, rtol=1e-9, atol=1e-6)
        assert other.rows == count


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_loss_weighs_rows_inside_the_kernels(hsr, backend):
    bound = bind(hsr.problem, hsr.problem.read(hsr.samples), backend=backend)
    x, loss = 0.2 * bound.start_std, huber()
    r, jacobian, normal = bound.residual(x), bound.jacobian(x), bound.normal(x, huber())
    weight = loss.weight(r)
    assert (weight < 0.5).any()
    assert normal.cost == pytest.approx(loss.cost(r).sum(), rel=1e-12)
    expected = jacobian.T @ (weight[:, None] * jacobian)
    np.testing.assert_allclose(normal.information, expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(normal.gradient, jacobian.T @ (weight * r), rtol=1e-9)


@pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler")
def test_estimates_do_not_depend_on_the_back_end(case):
    problem, samples, _ = case
    found = [[method(bind(problem, samples, backend=name)) for method in (lm, sckf, ekf)] for name in ("c", "blocks")]
    for one, other in zip(*found, strict=True):
        scale = one.problem.start_std
        np.testing.assert_allclose(one.x / scale, other.x / scale, rtol=0, atol=1e-10)


def test_every_operation_in_numpy_and_c_is_casadis():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    values = [
        x + y, x - y, x * y, x / y, -x, ca.exp(x), ca.log(x), x**y, x**3.5, ca.sqrt(x), x**2, 2 * x, ca.sin(x),
        ca.cos(x), ca.tan(x), ca.asin(x / 9), ca.acos(x / 9), ca.atan(x), ca.atan2(y, x), x < y, x <= y, x == y, x != y,
        ca.logic_not(x > y), ca.logic_and(x > 1, y > 1), ca.logic_or(x > 1, y > 1), ca.floor(x), ca.ceil(x),
        ca.fmod(x, y), ca.fabs(x - y), ca.sign(x - y), ca.copysign(x, x - y), ca.if_else(x > y, x, y), ca.erf(x),
        ca.fmin(x, y), ca.fmax(x, y), 1 / x, ca.sinh(x), ca.cosh(x), ca.tanh(x), ca.asinh(x), ca.acosh(x + 1),
        ca.atanh(x / 9), ca.hypot(x, y), ca.expm1(x), ca.log1p(x), ca.remainder(x, y),
    ]  # fmt: skip
    e = ca.vertcat(*values)
    function = ca.Function("all", [x, y], [e, ca.densify(ca.SX(e.numel(), 1))])
    program = read_program(function, ("once", "lane"))
    used = {program.operations[v].op for v in program.needed(program.results)} - {ca.OP_INPUT, ca.OP_CONST}
    assert used <= NUMPY.keys() & C.keys()
    assert len(used) > 40
    lanes = np.linspace(0.3, 2.9, 11)
    expected = np.array([np.array(function(1.7, value)[0]).ravel() for value in lanes]).T
    values = program.outputs[0]
    np.testing.assert_allclose(evaluate(program, values, [[1.7], [lanes]]), expected, rtol=1e-13, atol=1e-14)
    for name in ("blocks", "c") if HAS_COMPILER else ("blocks",):
        rows = row_kernels(function, name)
        assert rows.name == name
        packed = rows.lanes(lanes[:, None], np.ones((len(lanes), e.numel())))
        found = rows.residual(np.array([1.7]), packed)
        np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-14)


def test_sines_of_sums_are_split_and_nothing_else_changes():
    p, q = ca.SX.sym("p", 3), ca.SX.sym("q", 2)
    e = ca.sin(p[0] + q[0]) + ca.cos(q[1] - p[1]) * ca.sin(p[2] - (q[0] - q[1])) + ca.cos(q[0] * p[0])
    function = ca.Function("f", [p, q], [e, ca.jacobian(e, p).T])
    program = read_program(function, ("once", "lane"))
    mixed = [program.operations[v].op for v in program.needed(program.results) if program.kinds[v] == "mixed"]
    assert sum(op in (ca.OP_SIN, ca.OP_COS) for op in mixed) == 2  # of the product alone
    rng = np.random.default_rng(0)
    for _ in range(5):
        a, b = rng.normal(size=3), rng.normal(size=2)
        expected = [np.array(part).ravel() for part in function(a, b)]
        for values, part in zip(program.outputs, expected, strict=True):
            np.testing.assert_allclose(evaluate(program, values, [a, b]).ravel(), part, atol=1e-14)


ODD = [-math.inf, -1e300, -2.5, -1.0, -0.5, -1e-9, -0.0, 0.0, 1e-9, 0.3, 1.0, 2.5, 710.0, math.inf, math.nan]
UNARY = {name for name in NUMPY if ca.SX.binary(name, ca.SX.sym("x"), ca.SX.sym("y")).n_dep() == 1}


@pytest.mark.parametrize("op", sorted(NUMPY.keys() - {ca.OP_ASSIGN, ca.OP_LIFT}), ids=name_of)
def test_every_operation_is_casadis_on_odd_numbers_too(op, capfd):
    """On data alone, on parameters alone, on both; in C wherever it has a form there. The sign of zero counts."""
    pairs = np.array([(a, b) for a in ODD for b in ODD])
    x, y, q, r = (ca.SX.sym(name) for name in "xyqr")
    if op in UNARY:
        e = [ca.SX.unary(op, given) for given in (x, q, x + q - q)]
    else:
        e = [ca.SX.binary(op, *given) for given in ((x, y), (q, r), (x, r), (q, y))]
    function = ca.Function("f", [ca.vertcat(x, y), ca.vertcat(q, r)], [ca.vertcat(*e), ca.densify(ca.SX(len(e), 1))])
    assert op in {function.instruction_id(k) for k in range(function.n_instructions())} | {ca.OP_CONSTPOW}
    for name in ("blocks", "c") if HAS_COMPILER and op in C else ("blocks",):
        rows = row_kernels(function, name)
        assert rows.name == name
        packed = rows.lanes(pairs, np.ones((len(pairs), len(e))))
        for at in pairs[:: len(ODD) + 1]:
            expected = np.array(function.map(len(pairs))(ca.DM(at), ca.DM(pairs.T))[0])
            np.testing.assert_allclose(rows.residual(at, packed), expected, rtol=1e-13, atol=0)
    capfd.readouterr()  # printme prints


def test_an_operation_without_a_form_in_c_keeps_a_model_on_blocks(caplog):
    p, q = ca.SX.sym("p", 2), ca.SX.sym("q")
    e = ca.erfinv(p[0] * q) + p[1]  # of data alone it would be done before
    function = ca.Function("f", [p, q], [e, ca.jacobian(e, p).T])
    native_rows._notice.cache_clear()
    with caplog.at_level(logging.WARNING, "casacal"):
        rows = row_kernels(function, "auto")
    assert rows.name == "blocks"
    assert not HAS_COMPILER or "the operation 'erfinv' has no form in C" in caplog.text
    with pytest.raises(ProblemError, match="back end c cannot be used"):
        row_kernels(function, "c")
    lanes = np.linspace(-1.8, 1.8, 13)[:, None]
    packed = rows.lanes(lanes, np.full((13, 1), 2.0))
    at = np.array([0.5, 0.5])
    expected = np.array([float(function(at, value)[0]) for value in lanes.ravel()])
    np.testing.assert_allclose(rows.residual(at, packed)[0], expected)
    assert rows.costs(at[None], packed)[0] == pytest.approx(np.sum((expected / 2) ** 2) / 2)
    heavier = rows.reweighted(packed, np.full((1, 13), 1.0))
    assert rows.normal(at, heavier)[-1, -1] == pytest.approx(np.sum(expected**2))


@pytest.mark.parametrize("of", ["data alone", "parameters too"])
def test_a_function_that_casadi_cannot_write_out_is_called_row_by_row(of):
    class Table(DialOnPlane):
        def residual(self, pose, p, row):
            given = pose[0, 3] if of == "parameters too" else row.reading
            return super().residual(pose, p, row) + bend(given)

    bend = ca.interpolant("bend", "linear", [[0.0, 1.0, 2.0]], [0.0, 1.0, 4.0])
    model = Problem(hsr_robot(), Table(noise_std=0.05)).models[0]
    rng, (z, c, d) = np.random.default_rng(0), (model.residual.numel_in(i) for i in range(3))
    at, data = rng.normal(size=z + c) * 1e-3, rng.uniform(0, 1, (7, d))
    for backend in ("auto", "blocks"):
        rows = model.rows(backend)
        found = rows.residual(at, rows.lanes(data, np.full((7, 1), 0.05)))
        np.testing.assert_allclose(found[0], [float(model.residual(at[:z], at[z:], row)) for row in data], rtol=1e-12)
    with pytest.raises(ProblemError, match="back end c cannot be used: the model calls a rootfinder, a table"):
        model.rows("c")


def hsr_robot():
    return load_problem(ROOT / "problems" / "hsr_jr680").problem.robot


@pytest.mark.parametrize("backend", BACKENDS)
def test_constants_may_be_infinite(backend):
    p, q = ca.SX.sym("p"), ca.SX.sym("q")
    e = ca.vertcat(ca.fmin(q, ca.SX(ca.inf)) + p, ca.fmax(q * p, ca.SX(-ca.inf)) - 1e-300, ca.if_else(q > 0, p, ca.inf))
    rows = row_kernels(ca.Function("f", [p, q], [e, ca.densify(ca.SX(3, 1))]), backend)
    assert rows.name == backend
    lanes = np.array([[-1.0], [2.0]])
    found = rows.residual(np.array([3.0]), rows.lanes(lanes, np.ones((2, 3))))
    np.testing.assert_array_equal(found[:2], [[2.0, 5.0], [-3.0, 6.0]])
    assert found[2, 1] == 3.0 or np.isnan(found[2, 1])  # CasADi's if_else is 0 * inf where the condition fails


@pytest.mark.parametrize("backend", BACKENDS)
def test_comparisons_of_data_are_numbers(backend):
    """They are evaluated ahead for all rows: two that hold make two, and sines of them have sixteen digits."""
    p, q = ca.SX.sym("p"), ca.SX.sym("q")
    low, high = q > 0, q > 0.5
    parts = (
        low + high,
        low - high,
        ca.sin(low),
        ca.exp(ca.logic_not(low)),
        ca.logic_and(low, high) + ca.logic_or(low, high),
    )
    e = ca.vertcat(*parts) + p
    rows = row_kernels(ca.Function("f", [p, q], [e, ca.densify(ca.SX(5, 1))]), backend)
    lanes = np.array([[-1.0], [0.3], [2.0]])
    found = rows.residual(np.array([0.0]), rows.lanes(lanes, np.ones((3, 5))))
    first, second = (lanes.ravel() > 0) * 1.0, (lanes.ravel() > 0.5) * 1.0
    meant = [
        first + second,
        first - second,
        np.sin(first),
        np.exp(1 - first),
        first * second + np.maximum(first, second),
    ]
    np.testing.assert_allclose(found, meant, rtol=0, atol=1e-15)


def test_a_residual_that_does_not_touch_the_data_still_has_rows():
    robot = Robot("stub", joints=1, pose=lambda p, q: ca.SX.eye(4), parameters={"a": Parameter((1.0,), unit="mm")})

    class Constant(DialOnPlane):
        def residual(self, pose, p, row):
            return p.tool[0] - 3.0

    problem = Problem(robot, Constant(reading=False, noise_std=0.1))
    rows = row_kernels(problem.models[0].jacobian)
    packed = rows.lanes(np.zeros((5, 1)), np.ones((5, 1)))
    sizes = [problem.models[0].jacobian.numel_in(i) for i in (0, 1)]
    assert rows.residual(np.zeros(sum(sizes)), packed).shape == (1, 5)


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """An empty cache, and no memory of compilers or notices."""
    monkeypatch.setenv("CASACAL_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "user"))
    libraries._find_compiler.cache_clear()
    native_rows._notice.cache_clear()
    yield tmp_path / "cache"
    libraries._find_compiler.cache_clear()
    native_rows._notice.cache_clear()


def kernels(hsr, backend=None):
    return row_kernels(hsr.problem.models[0].jacobian, backend)


def test_without_a_compiler_blocks_serve_and_say_so_once(hsr, fresh, monkeypatch, caplog):
    monkeypatch.setenv("PATH", str(fresh))
    monkeypatch.delenv("CC", raising=False)
    with caplog.at_level(logging.WARNING, "casacal"):
        assert kernels(hsr).name == "blocks"
        assert kernels(hsr).name == "blocks"
    assert [record.getMessage() for record in caplog.records] == [
        "casacal: no C kernels (no C compiler found (gcc, clang, cc)); using blocks, which are slower"
    ]
    with pytest.raises(ProblemError, match="no C compiler found"):
        kernels(hsr, "c")


def test_a_broken_compiler_is_as_good_as_none(hsr, fresh, monkeypatch, caplog):
    broken = fresh.parent / "broken"
    broken.write_text("#!/bin/sh\n[ \"$1\" = --version ] && echo broken 1.0 && exit 0\necho 'ld: cannot' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setenv("CC", str(broken))
    with caplog.at_level(logging.WARNING, "casacal"):
        assert kernels(hsr).name == "blocks"
    assert "ld: cannot" in caplog.text
    assert list(fresh.iterdir()) == []


@pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler")
@pytest.mark.parametrize("unknown", ["-march=native", "native", "native|-fopenmp-simd"])
def test_a_compiler_that_does_not_know_all_options_is_asked_for_less(hsr, fresh, monkeypatch, unknown):
    """As Apple's, which refuses some of them."""
    real = next(found for name in ("gcc", "clang", "cc") if (found := shutil.which(name)))
    picky = fresh.parent / "picky"
    refuse = "".join(
        f'case "$*" in *{word}*) echo "unknown {word}" >&2; exit 1;; esac\n' for word in unknown.split("|")
    )
    picky.write_text(f'#!/bin/sh\n{refuse}exec {real} "$@"\n')
    picky.chmod(0o755)
    monkeypatch.setenv("CC", str(picky))
    assert kernels(hsr, "c").name == "c"


def test_a_compiler_of_macos_that_only_offers_xcode_is_none(monkeypatch):
    monkeypatch.setattr(libraries, "MACOS", True)
    asked = []

    def run(command, **_):
        asked.append(command[0])
        return subprocess.CompletedProcess(command, 2)

    monkeypatch.setattr(libraries.subprocess, "run", run)
    assert libraries._is_stub("/usr/bin/clang")
    assert not libraries._is_stub("/opt/homebrew/bin/gcc")
    assert asked == ["xcode-select"]  # the stub itself, which would open a window, is not run


def test_the_cache_of_windows_is_where_windows_keeps_caches(monkeypatch, tmp_path):
    monkeypatch.setattr(libraries, "WINDOWS", True)
    monkeypatch.delenv("CASACAL_CACHE", raising=False)
    monkeypatch.setenv("LOCALAPPDATA", str(tmp_path / "Local"))
    assert libraries.cache_folder() == tmp_path / "Local" / "casacal"


@pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler")
def test_a_user_without_a_home_gets_blocks(hsr, fresh, monkeypatch, caplog):
    for name in ("CASACAL_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(libraries.Path, "home", homeless)
    with caplog.at_level(logging.WARNING, "casacal"):
        assert kernels(hsr).name == "blocks"
    assert "no home folder" in caplog.text


def test_back_ends_are_chosen_by_name(hsr, monkeypatch):
    monkeypatch.setenv("CASACAL_BACKEND", "blocks")
    rows = hsr.problem.read(hsr.samples)
    assert bind(hsr.problem, rows).backend == "blocks"
    assert calibrate(hsr.problem, rows, reference=False).fit.backend == "blocks"
    monkeypatch.setenv("CASACAL_BACKEND", "gpu")
    with pytest.raises(ProblemError, match="no back end 'gpu'"):
        bind(hsr.problem, rows)


@pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler")
def test_a_spoilt_cache_is_made_again(hsr, fresh):
    assert kernels(hsr, "c").name == "c"
    (library,) = fresh.glob("*.so")
    good = library.read_bytes()
    library.unlink()  # the loaded file must not change under the process
    library.write_bytes(good[:-100] + bytes(100))
    library.chmod(0o700)
    assert kernels(hsr, "c").name == "c"
    (again,) = fresh.glob("*.so")
    assert again.read_bytes()[-100:] != bytes(100)


@pytest.mark.skipif(not HAS_COMPILER or os.name != "posix", reason="no C compiler, or no owners")
def test_what_others_can_write_is_not_loaded(hsr, fresh, caplog):
    kernels(hsr, "c")
    (library,) = fresh.glob("*.so")
    library.chmod(0o777)
    assert kernels(hsr, "c").name == "c"
    (again,) = fresh.glob("*.so")
    assert not again.stat().st_mode & 0o022
    fresh.chmod(0o777)
    with caplog.at_level(logging.WARNING, "casacal"):
        assert kernels(hsr).name == "blocks"
    assert "can be written by others" in caplog.text
    fresh.chmod(0o700)


@pytest.mark.long
@pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler")
def test_processes_that_race_for_the_cache_all_get_kernels(fresh):
    program = (
        "from casacal import load_problem, bind\ns = load_problem('problems/hsr_jr680')\n"
        "b = bind(s.problem, s.problem.read(s.samples))\nprint(b.backend, repr(b.normal(b.x0).cost))"
    )
    command = [sys.executable, "-c", program]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    racing = [
        subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    said = [process.communicate(timeout=120) for process in racing]
    assert {out.split()[0] for out, _ in said} == {"c"}
    assert len({out for out, _ in said}) == 1
    assert {error for _, error in said} == {""}
    assert not [path for path in fresh.iterdir() if path.suffix != ".so"]


@pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler")
@pytest.mark.parametrize(("count", "used"), [(60, "blocks"), (1001, "c")])
def test_few_rows_with_terms_do_not_wait_for_a_compiler(hsr, monkeypatch, count, used):
    """A compiler takes ten times as long as all the fits of few rows; many rows, and who asks, have their kernels."""
    monkeypatch.delenv("CASACAL_BACKEND", raising=False)
    problem = hsr.problem.with_terms(Backlash(size=1e-5))
    samples = simulate(hsr.problem, hsr.cell, samples=count, seed=1).samples
    bound = bind(problem, samples)
    assert bound.backend == used
    assert bind(hsr.problem, samples).backend == "c"
    assert bind(problem, samples, backend="c").backend == "c"
    few = bound.take(np.arange(50))
    assert few.backend == "blocks"
    monkeypatch.setenv("CASACAL_BACKEND", "c")
    assert bind(problem, samples).backend == "c"
    x = bound.start_std
    np.testing.assert_allclose(few.residual(x), bind(problem, samples).take(np.arange(50)).residual(x), atol=1e-9)
