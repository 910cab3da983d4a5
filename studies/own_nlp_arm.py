"""The arm of studies/own_nlp.py, two of whose links are equally long, and how a trial of it is judged."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from casacal import (
    Cell,
    DialOnPlane,
    Joint,
    Parameter,
    Problem,
    Robot,
    bind,
    chain,
    corner,
    deg,
    dh,
    huber,
    lm,
    simulate,
    tool_point,
)
from casacal.fit import LeastSquares, Result
from casacal.model.kinematics import hayati
from casacal.simulation import Simulated
from casacal.simulation.trials import SimulatedTrial

THRESHOLD = 1.345
"""Of Huber's loss, in standard deviations."""
LENGTH = 400.0
UPPER, FORE = "upper", "fore"


def arm(lengths: dict[str, Parameter], links: Callable[[Any], tuple[Any, Any]]) -> Problem:
    """Six axes of which 2, 3 and 4 are parallel, with the parameters of its two long links and how they make them."""

    def pose(p: Any, q: Any) -> Any:
        upper, fore = links(p)
        t = [p.theta[i] + q[i] for i in range(6)]
        return chain(
            dh(p.alpha[0], 0, p.d[0], t[0]),
            hayati(p.alpha[1], p.beta[0], -upper, t[1]),
            hayati(p.alpha[2], p.beta[1], -fore, t[2]),
            *(dh(p.alpha[i], 0, p.d[i - 2], t[i]) for i in (3, 4, 5)),
        )

    parameters = {
        "alpha": Parameter(deg(90, 0, 0, 90, -90, 0), unit="rad", prior_std=1e-3),
        "d": Parameter((89.0, 109.0, 95.0, 82.0), unit="mm", prior_std=0.7),
        "theta": Parameter((0.0,) * 6, unit="rad", prior_std=1e-3),
        "beta": Parameter((0.0, 0.0), unit="rad", prior_std=1e-3),
        **lengths,
    }
    robot = Robot("twin links", [Joint("revolute", *deg(-180, 180))] * 6, pose, parameters)
    return Problem(robot, DialOnPlane(noise_std=0.01, sign=-1, tool=tool_point(0, 0, 120, prior_std=1.0)))


def length() -> Parameter:
    """A long link, to 0.7 mm as a casting is."""
    return Parameter(LENGTH, unit="mm", prior_std=0.7)


TRUE = arm({"links": length()}, lambda p: (p.links, p.links))
FITTED = arm({UPPER: length(), FORE: length()}, lambda p: (p.upper, p.fore))
CELL = Cell(faces=corner((450.0, 0.0, 250.0), size=300.0))


class Tied(LeastSquares):
    """A problem with one unknown in place of two that are equal: x = T y."""

    def __init__(self, whole: LeastSquares) -> None:
        self.whole, self.kept = whole, [name for name in whole.names if name != FORE]
        places = [self.kept.index(UPPER if name == FORE else name) for name in whole.names]
        self.spread = np.eye(len(self.kept))[places]
        first = [whole.names.index(name) for name in self.kept]
        self.names, self.units = tuple(self.kept), tuple(whole.units[j] for j in first)
        self.x0, self.start_std, self.datum = whole.x0[first], whole.start_std[first], whole.datum[first]
        squares = self.spread.T @ np.diagonal(whole.prior_information)
        self.prior_std = np.where(squares > 0, 1 / np.sqrt(np.where(squares > 0, squares, 1)), np.inf)

    @property
    def rows(self) -> int:
        """Rows of the whole problem."""
        return self.whole.rows

    def residual(self, x: np.ndarray) -> np.ndarray:
        """Whitened residuals (rows,)."""
        return self.whole.residual(self.spread @ x)

    def jacobian(self, x: np.ndarray) -> np.ndarray:
        """Whitened Jacobian (rows, n - 1)."""
        return self.whole.jacobian(self.spread @ x) @ self.spread

    def row(self, k: int, states: np.ndarray) -> np.ndarray:
        """One whitened residual at many states."""
        return self.whole.row(k, states @ self.spread.T)

    def row_jacobian(self, k: int, x: np.ndarray) -> tuple[float, np.ndarray]:
        """One whitened residual and its gradient."""
        r, gradient = self.whole.row_jacobian(k, self.spread @ x)
        return r, gradient @ self.spread


def tied(problem: LeastSquares) -> np.ndarray:
    """LM with Huber's loss and one unknown for both links: what a program with the constraint must find."""
    one = Tied(problem)
    return one.spread @ lm(one, loss=huber(THRESHOLD)).x


@dataclass(frozen=True)
class OwnTrial(SimulatedTrial):
    """A trial that also compares with the library: objective and estimate, under each loss and constraint."""

    def judge(self, result: Result) -> dict[str, float]:
        """Figures of a simulated trial, and how far it is from LM with the same loss and links.

        gap_*: of the objective, relative, below zero where it is lower than LM's. apart_*: largest difference of an
        unknown, in posterior standard deviations.
        """
        figures = {**super().judge(result), "unequal_mm": abs(self._unequal(result.x))}
        for name, (x, std) in self._found.items():
            objective = self._plain if name == "square" else self._robust
            figures[f"gap_{name}"] = objective(result.x) / objective(x) - 1
            figures[f"apart_{name}"] = float(np.abs((result.x - x) / std).max())
        return figures

    @cached_property
    def _found(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """LM's x and its standard deviations, by what it minimised."""
        plain, robust = lm(self.problem), lm(self.problem, loss=huber(THRESHOLD))
        return {
            "square": (plain.x, plain.std),
            "huber": (robust.x, robust.std),
            "equal": (tied(self.problem), robust.std),
        }

    def _plain(self, x: np.ndarray) -> float:
        return self.problem.cost(x)

    def _robust(self, x: np.ndarray) -> float:
        return float(huber(THRESHOLD).cost(self.problem.residual(x)).sum()) + self.problem.prior_cost(x)

    def _unequal(self, x: np.ndarray) -> float:
        names = self.problem.names
        return float(x[names.index(UPPER)] - x[names.index(FORE)])


@dataclass(frozen=True)
class Twins(Simulated):
    """Trials in which the true links are equal, and the fitted problem has two."""

    def trial(self, seed: int) -> OwnTrial:
        """One arm and its touches."""
        simulation = simulate(self.problem, self.cell, samples=self.samples, seed=seed)
        local = {**simulation.local, **dict.fromkeys((UPPER, FORE), simulation.local["links"])}
        rows = np.arange(self.samples)
        fit = bind(self.fitted or self.problem, simulation.samples.take(rows[: -self.heldout]))
        heldout = fit.on(simulation.samples.take(rows[-self.heldout :]))
        return OwnTrial(fit, heldout, dataclasses.replace(simulation, local=local).truth(fit))
