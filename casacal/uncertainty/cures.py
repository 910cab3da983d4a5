"""The cheapest way to see a direction that the samples do not: found by computing what each cure would show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from casacal.array_types import Array
from casacal.binding.bound_problem import BoundProblem, bind
from casacal.binding.marginal import Seen, seen
from casacal.binding.slots import ENOUGH, nominal_sight
from casacal.errors import CasacalError
from casacal.instruments import Instrument
from casacal.problem.cell import Cell, Face
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples, joined
from casacal.simulation.simulate import simulate
from casacal.uncertainty.identifiability import NullDirection, WeakDirection

EXTRA_ROWS = 24
"""Touches that a cure adds."""
SEES = 2.0
"""A cure must raise the direction's whitened singular value above this: the data then know it better than the prior."""
STEP = 100.0
"""Known length that is offered as a cure, mm."""


@dataclass(frozen=True)
class Cure:
    """What to do, and what it would do: the nominal problem with the extra touches."""

    words: str
    bound: BoundProblem


def cures(bound: BoundProblem) -> list[Cure]:
    """Extra touches that could help, cheapest first: more tilt, another face, a known length.

    Simulated on the nominal arm and the nominal planes, without noise; a cure that this arm cannot reach is left out.
    Empty for instruments that know no faces by label, such as a tracker.
    """
    if len(bound.problem.instruments) != 1:
        return []
    labelled = bound.problem.instrument.with_faces_by_label()
    if labelled is None:
        return []
    found, here = [], _labelled(bound.block.samples, labelled)
    if len(here) > ENOUGH:
        here = here.take(np.arange(0, len(here), -(-len(here) // ENOUGH)))
    for words, problem, cell in _offers(bound, labelled):
        try:
            extra = simulate(problem, cell, samples=EXTRA_ROWS, seed=0).samples
            # a problem that only asks what if is not worth compiling
            backend = None if problem is bound.problem else "blocks"
            more = bind(problem, joined(here, extra), backend=backend)
            found.append(Cure(words, more.with_noise(*bound.noise_scale)))
        except CasacalError:
            continue
    return found


def cure_for(bound: Seen, offers: list[Cure], direction: NullDirection | WeakDirection, scale: Array) -> str:
    """The first offer that sees a direction, in words; says so when none does.

    Args:
        bound: the problem whose direction it is.
        offers: from `cures`.
        direction: in units of `scale`.
        scale: natural scale of the unknowns (n,).

    """
    arm = np.flatnonzero(~bound.datum)
    part = direction.direction[arm] / np.linalg.norm(direction.direction)
    if not np.abs(part).max(initial=0.0) > 0:
        return "none needed"
    if not offers:
        return "none known for this instrument; rely on the prior"
    names = {bound.names[j]: float(scale[j]) * value for j, value in zip(arm, part, strict=True)}
    for offer in offers:
        if _seen(offer.bound, names) > SEES:
            return offer.words
    return "neither tilt nor another face nor a known length helps; rely on the prior"


def _seen(bound: BoundProblem, names: dict[str, float]) -> float:
    """Whitened singular value along a direction of the arm, with all planes free."""
    arm, x0 = seen(bound, bound.x0)
    jacobian = arm.compact_jacobian(x0)
    along = np.zeros(arm.unknowns)
    for j, name in enumerate(arm.names):
        along[j] = names.get(name, 0.0)
    shown = jacobian @ along
    planes = jacobian[:, arm.datum]
    left = shown - planes @ np.linalg.lstsq(planes, shown, rcond=None)[0]
    return float(np.linalg.norm(left))


def _offers(bound: BoundProblem, labelled: Instrument) -> Iterator[tuple[str, Problem, Cell]]:
    """Words, problem and cell of each cure; the cell holds faces where the nominal arm found them."""
    faces, problem = _faces(bound), bound.problem
    if labelled is not problem.instrument:
        problem = Problem(problem.robot, labelled)
    calm = Cell(faces=faces, error_scale=0.0, repeatability=0.0, resolution=0.0)
    yield "tilt the tool by 10 degrees or more, up to 30", problem, calm
    first = faces[0]
    _, aside, across = first.axes
    for normal in (aside, -aside, across, -across):
        centre = np.asarray(first.centre) + 0.5 * first.size[0] * (first.axes[0] - normal)
        second = Face("second", _triple(centre), _triple(normal), first.size)
        yield "add a second face at right angles, tool tilted", problem, replace(calm, faces=(*faces, second))
    top = np.asarray(first.centre) + STEP * first.axes[0]
    stepped = labelled.with_step("known step", first.label, STEP)
    if stepped is None:
        return
    raised = Face("known step", _triple(top), first.normal, first.size)
    yield (
        f"measure one known length, such as a {STEP:g} mm gauge-block step",
        Problem(problem.robot, stepped),
        replace(calm, faces=(*faces, raised)),
    )


def _faces(bound: BoundProblem) -> tuple[Face, ...]:
    """Rectangles around the nominal tips of each face."""
    samples, instrument = bound.block.samples, bound.problem.instrument
    sight, labels = nominal_sight(bound.problem, 0, samples), samples.faces(instrument.groups)
    faces = []
    for slot in bound.slots:
        if (plane := slot.unknown.nominal_plane(slot.nominal)) is None:
            continue
        normal, base = plane
        own = [k for k, name in enumerate(labels.names) if instrument.instance(slot.key, name) == slot.label]
        tips = sight.tips if slot.label is None else sight.tips[np.isin(labels.codes, own)]
        face = Face(slot.label or "plane", _triple(base), _triple(normal))
        spans = np.ptp((tips - base) @ face.axes[1:].T, axis=0)
        faces.append(replace(face, size=(max(float(spans[0]), 50.0), max(float(spans[1]), 50.0))))
    return tuple(faces)


def _labelled(samples: Samples, labelled: Instrument) -> Samples:
    """Rows with a column of labels; those of a problem with one plane have none."""
    column = labelled.groups or "plane"
    return replace(samples, labels={**samples.labels, column: samples.faces(column)})


def _triple(values: Array | tuple[float, ...]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return x, y, z
