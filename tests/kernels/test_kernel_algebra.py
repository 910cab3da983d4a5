"""Rules that save work, exact curvature and compiled steps: against CasADi's own evaluation and plain NumPy."""

import re
import shutil
import subprocess
from collections import Counter
from importlib import resources

import casadi as ca
import numpy as np
import pytest
from test_kernels import HAS_COMPILER

from casacal import chain, dh
from casacal.kernels import native_rows as c_source
from casacal.kernels.block_rows import BlockKernels, Columnwise, CurvatureKernel
from casacal.kernels.program import evaluate, read_program
from casacal.model.kinematics import transform_point

C_FILES = sorted(each.name for each in (resources.files("casacal.kernels") / "c").iterdir())


def test_every_c_file_is_part_of_a_source():
    """As package data too: they are read from where the package is installed."""
    sources = [c_source.composed(names, {"ROWS": 4}) for names in (c_source.KERNELS, c_source.FILTER)]
    for name in C_FILES:
        own = "#define ROWS 4\n" if name == c_source.PROGRAM else c_source.INCLUDE.split(c_source.c_file(name))[-1]
        assert own.strip()
        assert [source.count(own) for source in sources] in ([1, 0], [0, 1], [1, 1]), name
    assert not any('#include "' in source for source in sources)


@pytest.mark.skipif(not HAS_COMPILER, reason="no C compiler")
@pytest.mark.parametrize("name", [name for name in C_FILES if name.endswith(".c")])
def test_every_c_file_stands_alone_as_c(name):
    """With the example in program.h, whose definitions are those that Python prints."""
    compiler = next(path for each in ("gcc", "clang", "cc") if (path := shutil.which(each)))
    strict = ["-std=gnu11", "-fopenmp-simd", "-Wall", "-Wextra", "-Werror", "-Wno-unused-function", "-fsyntax-only"]
    with resources.as_file(resources.files("casacal.kernels") / "c" / name) as path:
        done = subprocess.run([compiler, *strict, str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_example_header_defines_what_is_printed(monkeypatch):
    p, q = ca.SX.sym("p", 2), ca.SX.sym("q")
    e = p[0] * ca.sin(q) - p[1] ** 2
    slopes = ca.Function("e", [p, q], [e, ca.jacobian(e, p).T])
    given = {}
    monkeypatch.setattr(c_source, "composed", lambda names, definitions: given.update(definitions) or "")
    c_source.kernel_source(read_program(slopes, ("once", "lane")), 2)
    header = c_source.c_file(c_source.PROGRAM).replace("\\\n", "")
    example = dict(re.findall(r"^#define (\w+) +(.+?)(?: +/\*.*)?$", header, re.MULTILINE))
    assert example.keys() == given.keys()
    for name, value in given.items():
        expected = str(value) if isinstance(value, int) else " ".join(value)
        assert " ".join(example[name].split()) == expected


def arm(joints):
    """Distance of a tip from a plane, with its slopes, of an arm whose DH parameters are all unknown."""
    p, q, n = ca.SX.sym("p", 4 * joints), ca.SX.sym("q", joints), ca.SX.sym("n", 3)
    links = (dh(p[4 * i], p[4 * i + 1], p[4 * i + 2], p[4 * i + 3] + q[i]) for i in range(joints))
    e = ca.dot(n, transform_point(chain(*links), ca.SX([10.0, -20.0, 30.0]))) / n[0]
    return ca.Function("arm", [p, n, q], [e, ca.jacobian(e, ca.vertcat(p, n)).T])


def mixed(program):
    return [v for v in program.needed(program.results) if program.kinds[v] == "mixed"]


def test_sines_of_joints_and_offsets_are_done_apart_and_divisions_once():
    function = arm(6)
    program = read_program(function, ("once", "once", "lane"))
    assert len(mixed(program)) < function.n_instructions()
    assert not {program.operations[v].op for v in mixed(program)} & {ca.OP_SIN, ca.OP_COS, ca.OP_DIV}
    rng = np.random.default_rng(0)
    for _ in range(5):
        given = [rng.normal(size=24), rng.normal(size=3), rng.normal(size=6)]
        expected = [np.array(part).ravel() for part in function(*given)]
        for values, part in zip(program.outputs, expected, strict=True):
            np.testing.assert_allclose(evaluate(program, values, given).ravel(), part, rtol=1e-12, atol=1e-12)


def two_residuals():
    v, c, d = ca.SX.sym("v", 4), ca.SX.sym("c", 2), ca.SX.sym("d", 2)
    e = ca.vertcat(ca.sin(v[0] * d[0] + c[0]) * v[1], v[2] ** 2 * d[1] - c[1] * v[3] + ca.exp(v[0]) * v[2])
    return ca.Function("e", [v, c, d], [e])


@pytest.mark.parametrize("rows", [1, 100, 128, 700])
def test_cost_gradient_and_hessian_are_casadis(rows):
    residual = two_residuals()
    kernel, rng = CurvatureKernel(residual), np.random.default_rng(rows)
    data, noise = rng.normal(size=(rows, 2)), rng.uniform(0.5, 2.0, size=(rows, 2))
    v, c = rng.normal(size=4), rng.normal(size=2)
    symbol = ca.SX.sym("v", 4)
    total = sum(ca.sumsqr(residual(symbol, c, d) / w) for d, w in zip(data, noise, strict=True)) / 2
    hessian, gradient = ca.hessian(total, symbol)
    expected = ca.Function("f", [symbol], [total, gradient, hessian])(v)
    cost, slope, bend = kernel(v, c, kernel.lanes(data, noise))
    assert cost == pytest.approx(float(expected[0]), rel=1e-12)
    np.testing.assert_allclose(slope, np.array(expected[1]).ravel(), rtol=1e-11, atol=1e-11)
    np.testing.assert_allclose(bend, np.array(expected[2]), rtol=1e-11, atol=1e-11)


def test_curvature_of_a_graph_without_a_form_in_c():
    v, d = ca.SX.sym("v", 2), ca.SX.sym("d")
    residual = ca.Function("e", [v, ca.SX.sym("c", 0), d], [ca.vertcat(v[0] ** 2 * ca.erfinv(d * v[1]) - v[1] * v[0])])
    kernel, data = CurvatureKernel(residual), np.linspace(-0.5, 0.5, 9)[:, None]
    total = sum(ca.sumsqr(residual(v, [], value)) for value in data.ravel()) / 2
    expected = ca.Function("f", [v], [ca.hessian(total, v)[0]])([1.5, -0.5])
    found = kernel(np.array([1.5, -0.5]), np.zeros(0), kernel.lanes(data, np.ones((9, 1))))
    np.testing.assert_allclose(found[2], np.array(expected), rtol=1e-12)


@pytest.mark.parametrize("rows", [5, 5000])
def test_a_function_of_many_rows_is_casadis(rows):
    residual, rng = two_residuals(), np.random.default_rng(0)
    v, c, data = rng.normal(size=4), rng.normal(size=2), rng.normal(size=(rows, 2))
    found = Columnwise(residual)(v, c, data)
    expected = np.array(residual.map(rows)(v, c, data.T)).T
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-13)


def test_blocks_do_each_operation_once():
    """Residual and slopes share most of their work; CasADi's machine does what it is given, twice if given twice."""
    program = read_program(arm(6), ("once", "once", "lane"))
    function = BlockKernels(program, 27)._built("slopes", 128)
    done = Counter(function.instruction_id(k) for k in range(function.n_instructions()))
    needed = Counter(program.operations[value].op for value in mixed(program))
    assert needed.total() > 200
    assert {op: done[op] for op in needed} == dict(needed)
