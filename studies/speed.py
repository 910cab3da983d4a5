"""How near does the symbolic model come to C written by hand for one case?

One six-axis standard DH arm in contact with one plane, 27 unknowns. Kernels printed as C and replayed in blocks,
CasADi's plain map, SciPy on the same kernels, filterpy's cubature filter, and the limit: C written by hand for exactly
this case (studies/speed/limit.c, compiled by this study). All contenders of a table take turns in one run, and only
ratios of their medians travel to another machine.

    casacal study studies/speed.py [--quick] [--out DIR]
"""

import ctypes
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.optimize import least_squares

from casacal import BoundProblem, DialOnPlane, Plane, Problem, Run, bind, lm, load_problem, sckf
from casacal.errors import ProblemError
from casacal.kernels.batch import Batch
from casacal.kernels.compiler import CompilerError, load_library
from casacal.samples import Samples
from casacal.unknowns.unknown import tangent_basis
from studies.reporting import PROBLEMS, figure, save, script, table

try:  # another library's filter, where it is installed
    from filterpy.kalman import CubatureKalmanFilter
except ImportError:
    CubatureKalmanFilter = None

LIMIT, PRINTED, BLOCKS, MAP = "C by hand", "c", "blocks", "CasADi map"
EVALUATIONS = 5
"""Of the normal equations, that LM by hand does without asking: as many as casacal's needs."""
CANDIDATES = 100
NOISE = 0.05


@dataclass(frozen=True)
class Case:
    """The same rows for all: bound on each back end, and as the C by hand reads them."""

    c: BoundProblem | None
    blocks: BoundProblem
    truth: np.ndarray
    q: np.ndarray
    w: np.ndarray
    p: np.ndarray


def case(rows: int) -> Case:
    """An arm with prior errors and `rows` random poses, moved by their first joint but one until they touch."""
    robot = load_problem(PROBLEMS / "hsr_jr680").problem.robot
    normal, point = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0]), np.array([1200.0, 0.0, 400.0])
    plane = Plane(tuple(normal), tuple(point), start_std=(0.01, 10.0))
    problem = Problem(robot, DialOnPlane(reading=False, noise_std=NOISE, plane=plane))
    rng = np.random.default_rng(0)
    joints = rng.uniform(-0.6, 0.6, size=(rows, 6))
    x = np.concatenate([0.3 * np.concatenate([u.prior_stds for u in robot.parameters.values()])
                        * rng.normal(size=24), [1e-3, -2e-3, 1.5]])  # fmt: skip
    for _ in range(8):  # secant steps of joint 2 onto the true plane
        gap, slope = distance(problem, joints, x), distance(problem, joints + 1e-6 * np.eye(6)[1], x)
        joints[:, 1] -= np.clip(gap / ((slope - gap) / 1e-6), -0.2, 0.2)
    frame = pd.DataFrame(joints + 1e-5 * rng.normal(size=joints.shape), columns=[f"q{i}_rad" for i in range(1, 7)])
    samples = Samples.from_frame(frame, problem.layout())
    kept = np.abs(distance(problem, samples.joints, x)) < 1.0
    samples = samples.take(np.resize(np.flatnonzero(kept), rows))
    blocks = bind(problem, samples, backend="blocks")
    try:
        printed = bind(problem, samples, backend="c")
    except ProblemError:  # no compiler: the page says so
        printed = None
    tangents = tangent_basis(normal).T
    values = [np.concatenate([np.asarray(u.values, float) for u in robot.parameters.values()]), normal, *tangents]
    p = np.concatenate([*values, [normal @ point]])
    pad = ((0, 0), (0, -rows % 8))
    q = np.ascontiguousarray(np.pad(np.vstack([np.sin(samples.joints.T), np.cos(samples.joints.T)]), pad))
    w = np.ascontiguousarray(np.pad(np.full((1, rows), 1 / NOISE), pad))
    return Case(printed, blocks, x, q, w, p)


def distance(problem: Problem, joints: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Distance (N,) of the tips from the plane at x."""
    frame = pd.DataFrame(joints, columns=[f"q{i}_rad" for i in range(1, 7)])
    return bind(problem, Samples.from_frame(frame, problem.layout()), backend="blocks").plain_residual(x)


class ByHand:
    """The functions of limit.c on a case."""

    def __init__(self, made: Case) -> None:
        self.functions = load_library((Path(__file__).parent / "speed" / "limit.c").read_text(encoding="utf-8"))
        self.made, self.n, self.ld = made, made.blocks.rows, made.q.shape[1]
        self.e, self.j, self.s = np.empty(self.ld), np.empty((27, self.ld)), np.empty((28, 28))
        self.x, self.states = np.empty(27), np.tile(made.p, (CANDIDATES, 1))
        scale, prior, out = made.blocks.start_std.copy(), made.blocks.prior_information.copy(), np.empty(CANDIDATES)
        self.slopes = self._bound("limit_slopes", made.p, made.q, self.e, self.j)
        self.normal = self._bound("limit_normal", made.p, made.q, made.w, self.s)
        self.costs = self._bound("limit_costs", CANDIDATES, self.states, made.q, made.w, out)
        self.lm = self._bound("limit_lm", made.p, made.q, made.w, scale, prior, EVALUATIONS, self.x)

    def _bound(self, name: str, *values: np.ndarray | int) -> Callable[[], None]:
        """A function of the library on these arguments, after the rows' counts; a call costs a microsecond."""
        given = [v.ctypes.data if isinstance(v, np.ndarray) else v for v in values]
        types = [ctypes.c_void_p if isinstance(v, np.ndarray) else ctypes.c_long for v in values]
        function = self.functions[name]
        function.argtypes, function.restype = [ctypes.c_long, ctypes.c_long, *types], None
        call = partial(function, self.n, self.ld, *given)
        call.kept = values  # pointers do not keep arrays alive
        return call


def medians(contenders: dict[str, Callable[[], object]], seconds: float) -> dict[str, float]:
    """Median time (s) of each, all taking turns until the time is up, three turns at least; first turn untimed."""
    times: dict[str, list[float]] = {name: [] for name in contenders}
    for call in contenders.values():
        call()
    ends = time.perf_counter() + seconds
    while time.perf_counter() < ends or min(map(len, times.values())) < 3:
        for name, call in contenders.items():
            began = time.perf_counter()
            call()
            times[name].append(time.perf_counter() - began)
    return {name: float(np.median(values)) for name, values in times.items()}


def kernels(bound: BoundProblem) -> tuple[object, np.ndarray, object]:
    """The kernels of a bound problem, its parameters at x0 and its lanes."""
    (groups,) = bound._groups
    (block,) = bound.blocks
    rows = groups._rows
    p = np.concatenate([bound.x0[block.columns[0]], block.constants[0]])
    return rows.kernels, p, rows.lanes([block.data], block.noise)


def mapped(bound: BoundProblem) -> Callable[[], object]:
    """Residual and Jacobian by CasADi's map of the row function."""
    (block,) = bound.blocks
    batch = Batch(block.model.jacobian)
    return lambda: batch(bound.x0[block.columns[0]], block.constants[0], block.data)


def slopes_contenders(made: Case) -> dict[str, Callable[[], object]]:
    """Residual and Jacobian."""
    found: dict[str, Callable[[], object]] = {LIMIT: ByHand(made).slopes}
    for name, bound in ((PRINTED, made.c), (BLOCKS, made.blocks)):
        if bound is not None:
            kernel, p, lanes = kernels(bound)
            found[name] = lambda kernel=kernel, p=p, lanes=lanes: kernel.slopes(p, lanes)
    return {**found, MAP: mapped(made.blocks)}


def normal_contenders(made: Case) -> dict[str, Callable[[], object]]:
    """Normal equations."""
    found: dict[str, Callable[[], object]] = {LIMIT: ByHand(made).normal}
    for name, bound in ((PRINTED, made.c), (BLOCKS, made.blocks)):
        if bound is not None:
            kernel, p, lanes = kernels(bound)
            found[name] = lambda kernel=kernel, p=p, lanes=lanes: kernel.normal(p, lanes)
    return found


def cost_contenders(made: Case) -> dict[str, Callable[[], object]]:
    """Objective of a hundred candidates."""
    found: dict[str, Callable[[], object]] = {LIMIT: ByHand(made).costs}
    for name, bound in ((PRINTED, made.c), (BLOCKS, made.blocks)):
        if bound is not None:
            states = np.tile(bound.x0, (CANDIDATES, 1))
            found[name] = lambda bound=bound, states=states: bound.costs(states)
    return found


def fit_contenders(made: Case) -> dict[str, Callable[[], object]]:
    """Whole fits from the drawing."""
    found: dict[str, Callable[[], object]] = {LIMIT: ByHand(made).lm}
    for name, bound in ((PRINTED, made.c), (BLOCKS, made.blocks)):
        if bound is not None:
            found[name] = lambda bound=bound: lm(bound)
    best = made.c if made.c is not None else made.blocks
    scale, pull = best.start_std, np.sqrt(best.prior_information) * best.start_std

    def residual(y: np.ndarray) -> np.ndarray:
        return np.concatenate([best.residual(scale * y), pull * y])

    def jacobian(y: np.ndarray) -> np.ndarray:
        return np.vstack([best.jacobian(scale * y) * scale, np.diag(pull)])

    found["SciPy lm, same kernels"] = lambda: least_squares(residual, np.zeros(27), jacobian, method="lm")
    if best.rows <= 10_000:
        found["SciPy lm, 2-point"] = lambda: least_squares(residual, np.zeros(27), method="lm")
    return found


def filter_contenders(made: Case) -> dict[str, Callable[[], object]]:
    """One pass of the cubature filter over the rows."""
    bound = made.c if made.c is not None else made.blocks
    scale = bound.start_std

    def predicted(y: np.ndarray, k: int) -> np.ndarray:
        return bound.row(k, (scale * y.ravel())[None])

    def theirs() -> None:
        other = CubatureKalmanFilter(27, 1, 1.0, hx=predicted, fx=lambda x, _: x)
        other.x, other.P, other.R, other.Q = np.zeros((27, 1)), np.eye(27), np.eye(1), np.zeros((27, 27))
        for k in range(bound.rows):
            other.predict()
            other.update(np.zeros((1, 1)), hx_args=(k,))

    found = {"casacal, c" if made.c is not None else "casacal, blocks": lambda: sckf(bound)}
    if made.c is not None:
        found["casacal, blocks"] = lambda: sckf(made.blocks)
    return {**found, "filterpy, same h": theirs} if CubatureKalmanFilter is not None else found


def checked(made: Case) -> float:
    """Largest difference of the C by hand from casacal's blocks: residuals in mm, arm's columns over their largest."""
    hand = ByHand(made)
    hand.slopes()
    kernel, p, lanes = kernels(made.blocks)
    e, j = kernel.slopes(p, lanes)
    arm = np.abs(hand.j[:24, : hand.n] - j[0][:24]).max() / np.abs(j).max()
    return float(max(np.abs(hand.e[: hand.n] - e[0]).max(), arm))


def compared(
    title: str, what: Callable[[Case], dict], cases: dict[int, Case], seconds: float
) -> tuple[list[str], dict]:
    """Lines of a table of medians, with each contender's ratio to the first, and the medians themselves."""
    found = {rows: medians(what(made), seconds) for rows, made in cases.items()}
    names = list(dict.fromkeys(name for times in found.values() for name in times))
    body = []
    for name in names:
        cells = []
        for times in found.values():
            first = next(iter(times.values()))
            cells.append(f"{1e6 * times[name]:,.3g} ({times[name] / first:.2f})" if name in times else "")
        body.append((name, *cells))
    header = (f"{title}, us (ratio)", *(f"N = {rows:,}" for rows in found))
    return table(header, body), found


def report(run: Run) -> list[str]:
    """Four tables, growth with the number of rows, and the filter."""
    sizes = (120, 1000) if run.quick else (120, 1000, 10_000, 100_000)
    seconds = 0.1 if run.quick else 3.0
    cases = {rows: case(rows) for rows in sizes}
    try:
        agreement = checked(cases[120])
    except CompilerError as error:
        return ["# Speed", "", f"There is no working C compiler here ({error}), so nothing was compared.", "",
                *table(("", ""), [])]  # fmt: skip
    lines = [
        "# How near the symbolic model comes to C by hand",
        "",
        "One six-axis standard DH arm in contact with one plane, 24 parameters, two tilts and an offset. Medians in",
        "microseconds, all contenders of a table in turns in one run; in brackets the ratio to the first. The C by",
        f"hand writes into memory it was given; its results differ from casacal's by {agreement:.0e} at most (mm, and",
        "relative for the Jacobian).",
        "",
    ]
    growth = {}
    for title, what in (("residual and Jacobian", slopes_contenders), ("normal equations", normal_contenders),
                        ("LM from the drawing", fit_contenders)):  # fmt: skip
        made, growth[title] = compared(title, what, cases, seconds)
        lines += [f"## {title[0].upper()}{title[1:]}", "", *made, ""]
    small = {120: cases[120]}
    lines += [f"## {CANDIDATES} candidates", "", *compared("objective", cost_contenders, small, seconds)[0], ""]
    lines += ["## One pass of the cubature filter", "", *compared("SCKF", filter_contenders, small, seconds)[0], ""]
    draw(growth, run.out / "growth.png")
    return [*lines, "![time over the number of rows](growth.png)"]


def draw(growth: dict[str, dict[int, dict[str, float]]], path: Path) -> None:
    """Time over the number of rows, one panel a task, with the exponent of each contender in the legend."""
    made = figure(13, 4.2)
    for axes, (title, found) in zip(made.subplots(1, len(growth)), growth.items(), strict=True):
        for name in dict.fromkeys(name for times in found.values() for name in times):
            points = [(rows, times[name]) for rows, times in found.items() if name in times]
            rows, values = np.array(points).T
            exponent = np.polyfit(np.log(rows[-2:]), np.log(values[-2:]), 1)[0]
            axes.loglog(rows, values, "o-", ms=3, lw=1.2, label=f"{name}, N^{exponent:.2f}")
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("rows")
        axes.legend(frameon=False, fontsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    made.axes[0].set_ylabel("seconds")
    save(made, path)


if __name__ == "__main__":
    script(__file__)
