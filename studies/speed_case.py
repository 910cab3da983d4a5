"""The case of the speed study: one six-axis arm in contact with one plane, for casacal and as C by hand reads it."""

import ctypes
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from casacal import DialOnPlane, Plane, Problem, bind, load_problem, sckf
from casacal.data.samples import Samples
from casacal.errors import ProblemError
from casacal.fit import BoundProblem
from casacal.kernels.libraries import load_library
from casacal.model.unknown import tangent_basis
from studies.reporting import PROBLEMS

CANDIDATES = 100
NOISE = 0.05
DIFFERENT = 50_000
"""Rows that are drawn; more repeat them."""
NORMAL, POINT = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0]), np.array([1200.0, 0.0, 400.0])


@dataclass(frozen=True)
class Case:
    """The same rows for all: bound on each back end with one thread, and as the C by hand reads them."""

    c: BoundProblem | None
    blocks: BoundProblem
    two: BoundProblem
    """The better of the two with two threads."""
    q: np.ndarray
    w: np.ndarray
    p: np.ndarray

    @property
    def best(self) -> BoundProblem:
        """In C, where there is a compiler."""
        return self.c if self.c is not None else self.blocks


def arm_at_a_plane() -> Problem:
    """The HSR-JR680, its tip on one plane, without a dial."""
    plane = Plane(tuple(NORMAL), tuple(POINT), start_std=(0.01, 10.0))
    robot = load_problem(PROBLEMS / "hsr_jr680").problem.robot
    return Problem(robot, DialOnPlane(reading=False, noise_std=NOISE, plane=plane))


def touches(problem: Problem, rows: int) -> np.ndarray:
    """Joint values (rows, 6) of a true arm with prior errors, moved by joint 2 until they touch, and their noise."""
    rng, drawn = np.random.default_rng(0), min(rows, DIFFERENT)
    joints = rng.uniform(-0.6, 0.6, size=(2 * drawn, 6))
    arm = np.concatenate([u.prior_stds for u in problem.robot.parameters.values()])
    truth = np.concatenate([0.3 * arm * rng.normal(size=24), [1e-3, -2e-3, 1.5]])
    for _ in range(8):  # secant steps
        gap, slope = distance(problem, joints, truth), distance(problem, joints + 1e-6 * np.eye(6)[1], truth)
        joints[:, 1] -= np.clip(gap / ((slope - gap) / 1e-6), -0.2, 0.2)
    joints = joints[np.abs(distance(problem, joints, truth)) < 1e-3]
    joints = np.resize(joints + 1e-5 * rng.normal(size=joints.shape), (min(rows, drawn), 6))
    return np.resize(joints, (rows, 6))


def distance(problem: Problem, joints: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Distance (N,) of the tips from the plane at x."""
    return bind(problem, samples_of(problem, joints), backend="blocks").plain_residual(x)


def samples_of(problem: Problem, joints: np.ndarray) -> Samples:
    """Joint values as samples."""
    frame = pd.DataFrame(joints, columns=[f"q{i}_rad" for i in range(1, 7)])
    return Samples.from_frame(frame, problem.layout())


def case(rows: int) -> Case:
    """So many rows."""
    problem = arm_at_a_plane()
    samples = samples_of(problem, touches(problem, rows))
    blocks = bind(problem, samples, backend="blocks", threads=1)
    try:
        printed = bind(problem, samples, backend="c", threads=1)
    except ProblemError:  # no compiler: the page says so
        printed = None
    two = bind(problem, samples, backend="blocks" if printed is None else "c", threads=2)
    values = [np.asarray(u.values, float) for u in problem.robot.parameters.values()]
    p = np.concatenate([*values, NORMAL, *tangent_basis(NORMAL).T, [NORMAL @ POINT]])
    pad = ((0, 0), (0, -rows % 8))
    q = np.pad(np.vstack([np.sin(samples.joints.T), np.cos(samples.joints.T)]), pad)
    return Case(printed, blocks, two, aligned(q), aligned(np.pad(np.full((1, rows), 1 / NOISE), pad)), p)


def aligned(values: np.ndarray) -> np.ndarray:
    """The same numbers, beginning at a multiple of 64 bytes."""
    raw = np.empty(values.size + 8)
    skipped = -(raw.ctypes.data // 8) % 8
    place = raw[skipped : skipped + values.size].reshape(values.shape)
    place[:] = values
    return place


def kernels(bound: BoundProblem) -> tuple[object, np.ndarray, object]:
    """The kernels of a bound problem, its parameters at x0, and all its rows as lanes."""
    (block,) = bound.blocks
    p = np.concatenate([bound.x0[block.columns[0]], block.constants[0]])
    found = block.model.rows(bound.backend)
    return found, p, found.lanes(block.rows(slice(None)), block.noise)


class ByHand:
    """The functions of limit.c on a case, writing to memory that is there already."""

    def __init__(self, made: Case, *, evaluations: int = 5) -> None:
        source = (Path(__file__).parent / "speed" / "limit.c").read_text(encoding="utf-8")
        self.functions = load_library(source, ("limit_normal", "limit_costs", "limit_lm"))
        self.made, self.n, self.ld = made, made.blocks.rows, made.q.shape[1]
        self.x, self.states = np.empty(27), np.tile(made.p, (CANDIDATES, 1))
        self.s, out = np.empty((28, 28)), np.empty(CANDIDATES)
        scale, prior = made.blocks.start_std.copy(), np.diagonal(made.blocks.prior_information).copy()
        self.normal = self._bound("limit_normal", self.n, self.ld, made.p, made.q, made.w, self.s)
        self.costs = self._bound("limit_costs", self.n, self.ld, CANDIDATES, self.states, made.q, made.w, out)
        fit = (made.p, made.q, made.w, scale, prior, evaluations, self.x)
        self.lm = self._bound("limit_lm", self.n, self.ld, *fit)
        joints, work = np.ascontiguousarray(made.blocks.samples[0].joints.T), np.empty(28 * 56 + 27 * 27)
        begun = np.concatenate([made.p, POINT])
        self.filter = self._bound("limit_filter", self.n, begun, joints, scale, NOISE, self.x, work)

    def normal_by_two(self) -> Callable[[], None]:
        """Normal equations of each half of the rows on a thread of its own: what two threads gain on this machine."""
        first = self.n // 16 * 8
        q, w = (aligned(each[:, first:]) for each in (self.made.q, self.made.w))
        others = self._bound("limit_normal", self.n - first, q.shape[1], self.made.p, q, w, np.empty((28, 28)))
        mine = self._bound("limit_normal", first, self.ld, self.made.p, self.made.q, self.made.w, self.s)
        pool = ThreadPoolExecutor(1)

        def both() -> None:
            waiting = pool.submit(others)
            mine()
            waiting.result()

        return both

    def slopes(self, *, past: bool = False) -> Callable[[], None]:
        """Residual and Jacobian, written past the caches if asked; `e` and `j` are what it fills."""
        self.e, self.j = np.empty(self.ld), aligned(np.empty((27, self.ld)))
        name = "limit_slopes_past" if past else "limit_slopes"
        return self._bound(name, self.n, self.ld, self.made.p, self.made.q, self.e, self.j)

    def _bound(self, name: str, *values: np.ndarray | int | float) -> Callable[[], None]:
        """A function of the library on these arguments; a call costs a microsecond."""
        kinds = {int: ctypes.c_long, float: ctypes.c_double}
        given = [v.ctypes.data if isinstance(v, np.ndarray) else v for v in values]
        function = self.functions[name]
        function.argtypes, function.restype = [kinds.get(type(v), ctypes.c_void_p) for v in values], None
        call = partial(function, *given)
        call.kept = values  # pointers do not keep arrays alive
        return call


def agreement(made: Case) -> float:
    """Largest difference of the C by hand from casacal: residuals in mm, the arm's columns and the filter relative."""
    hand = ByHand(made)
    hand.slopes()()
    kernel, p, lanes = kernels(made.blocks)
    e, j = kernel.slopes(p, lanes)
    arm = np.abs(hand.j[:24, : hand.n] - j[0][:24]).max() / np.abs(j).max()
    hand.filter()
    filtered = np.abs((hand.x - sckf(made.blocks).x) / made.blocks.start_std).max()
    return float(max(np.abs(hand.e[: hand.n] - e[0]).max(), arm, filtered))
