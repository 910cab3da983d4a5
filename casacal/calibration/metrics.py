"""Figures of residuals before and after, of fitted and of held-out rows: not accuracy."""

from __future__ import annotations

from typing import TypeAlias

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.uncertainty.figures import residual_figures

Figures: TypeAlias = dict[str, float]
Metrics: TypeAlias = dict[str, dict[str, Figures | None]]
"""By "before" and "after", then by "fit" and "heldout"; None where no row is held out."""

WHEN = ("before", "after")

Pair: TypeAlias = tuple[Array, Array]  # unknowns (n,) before and after


def residual_metrics(fit: BoundProblem, heldout: BoundProblem | None, xs: Pair, held: Pair) -> Metrics:
    """Of all residuals that are in the unit in which their instrument speaks."""
    return {
        when: {"fit": _leading(fit, x), "heldout": None if heldout is None else _leading(heldout, there)}
        for when, x, there in zip(WHEN, xs, held, strict=True)
    }


def metrics_by_part(fit: BoundProblem, heldout: BoundProblem | None, xs: Pair, held: Pair) -> dict[str, Metrics]:
    """The same of each of several instruments and of each block of a residual, in its own unit, by name.

    Nothing for an only instrument whose residual has no blocks.
    """
    if not parts_of(fit):
        return {}
    return {
        name: {
            when: {"fit": _part(name, fit, x), "heldout": None if heldout is None else _part(name, heldout, there)}
            for when, x, there in zip(WHEN, xs, held, strict=True)
        }
        for name in parts_of(fit)
    }


def parts_of(fit: BoundProblem) -> dict[str, str]:
    """The unit of each of several instruments and of each block of a residual, by the name of its noise; else none."""
    problem = fit.problem
    if len(problem.instruments) == 1 and not problem.instruments[0].blocks:
        return {}
    found: dict[str, str] = {}
    for name, instrument in zip(problem.names, problem.instruments, strict=True):
        before = f"{name} " if len(problem.instruments) > 1 else ""
        blocks = {f"{before}{block.name}": block.unit for block in instrument.blocks}
        found |= blocks or {name: instrument.words.unit}
    return found


def more_than_stated(fit: BoundProblem, most: float) -> str:
    """A sentence on which instruments, or blocks of a residual, err more than was stated, and which do not."""
    factors = {name: fit.scale[name] for name in parts_of(fit) if name in fit.scale}
    more = [f"{name} {factor:.2g}" for name, factor in factors.items() if factor > most]
    right = [name for name, factor in factors.items() if factor <= most]
    others = f", {' and '.join(right)} as stated" if right else ""
    return f"Times the stated noise: {', '.join(more)}{others}. " if more else ""


def _leading(bound: BoundProblem, x: Array) -> Figures:
    return residual_figures(bound.plain_residual(x)[bound.leading])


def _part(name: str, bound: BoundProblem, x: Array) -> Figures | None:
    rows = bound.noise_labels.rows().get(name)
    return None if rows is None or not rows.size else residual_figures(bound.plain_residual(x)[rows])
