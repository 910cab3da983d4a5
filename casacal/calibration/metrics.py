"""Figures of residuals before and after, of fitted and of held-out rows: not accuracy."""

from __future__ import annotations

from typing import TypeAlias

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem
from casacal.uncertainty.figures import residual_figures

Figures: TypeAlias = dict[str, float]
Metrics: TypeAlias = dict[str, dict[str, Figures | None]]
"""Keys "before" and "after", then "fit" and "heldout"; None where no row is held out."""

Pair: TypeAlias = tuple[Array, Array]  # unknowns (n,) before and after


def metrics_of(
    fit: BoundProblem, heldout: BoundProblem | None, xs: Pair, held: Pair, *, part: str | None = None
) -> Metrics:
    """Residual figures in the instrument's unit; with `part`, of one of `parts_of` in its own unit."""

    def figures(bound: BoundProblem, x: Array) -> Figures | None:
        if part is None:
            return residual_figures(bound.plain_residual(x)[bound.leading])
        rows = bound.noise_labels.rows().get(part)
        return None if rows is None or not rows.size else residual_figures(bound.plain_residual(x)[rows])

    return {
        when: {"fit": figures(fit, x), "heldout": None if heldout is None else figures(heldout, there)}
        for when, x, there in zip(("before", "after"), xs, held, strict=True)
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
