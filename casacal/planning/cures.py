"""Cures for an uncertain calibration, best first: planned extra touches, added to the samples and judged at the tip.

Every figure is worked out at the estimate, as the tip error to expect is: the arm as calibrated can touch its faces as
they were found in many postures, those that leave the least error are chosen of them by exchange, as `plan` does, and
the linearised touches are added to what the samples know, everything free.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import block_diag

from casacal.data.samples import Samples
from casacal.effects.selection import MANY
from casacal.errors import CasacalError
from casacal.fit.arm_alone import ArmProblem
from casacal.fit.bound_problem import OTHERS, BoundProblem, by_face, times
from casacal.fit.slots import Slot, make_slots
from casacal.linalg import posterior_covariance
from casacal.model.problem import Problem
from casacal.planning.choice import Choice
from casacal.planning.offers import EXTRA_TOUCHES, CalibratedCell, Offer, more_samples, offers
from casacal.simulation.cell import Cell, Disturbances
from casacal.simulation.touches import Draw
from casacal.uncertainty.identifiability import NullDirection, WeakDirection, prior_scale
from casacal.uncertainty.tip_error import tip_stds, tool_unknowns, without_rigid, workspace_joints
from casacal.values import Array
from casacal.wording import listed

GAIN = 0.95  # expected tip error over that without a cure, above which it is not worth recommending
SAME = 0.99  # tip error over that of more touches of the same kind, above which a larger tilt is no cure
TOOL_STD = 0.2  # standard deviation (mm) of a tool's point that is measured with a caliper or a height gauge
SETTLES = 0.5  # part of a direction's standard deviation below which a cure settles it
LOWERS = 0.95  # standard deviation over that without a cure, below which the cure helps at all
MOST_TILT = math.radians(85.0)  # tilt of a plunger that hardly touches a face: such an arm is not understood
NO_CURE = "none of those tried helps; rely on the prior"
POOL = 240  # samples that are drawn, to choose among
ROUNDS = 3  # times that their postures are sought; what is not found then is hard to reach
FEWEST = 120  # samples without which there is nothing to choose among


@dataclass(frozen=True, eq=False)
class Cure:
    """A recommended next step, and the tip error to expect after it.

    expected_rms_mm: over the workspace, apart from the pose of the base. recommended: whether it gains more than a
    few per cent, over as many touches of the same kind too. covariance: of the geometry that the samples share (s, s),
    after it.
    """

    words: str
    touches: int
    expected_rms_mm: float
    recommended: bool
    covariance: Array = field(repr=False)


@dataclass(frozen=True, eq=False)
class CureOutcome:
    """Expected accuracy after a cure.

    information: all there would be (m, m); the first unknowns are those that the samples share. rows: the touches that
    were chosen, where they were. problem: whose rows these are, with a new face or step.
    """

    kind: str
    words: str
    touches: int
    information: Array
    prior: Array
    rows: Samples | None = None
    problem: Problem | None = None


def cures(bound: BoundProblem, x: Array, *, stays: float = 0.0) -> tuple[Cure, ...]:
    """Next steps at x (n,), best first: 24 planned touches of each kind, and a measured tool.

    More of the same, 60 of them too; more tilt; another face at right angles; a plate that stands alone, inclined; a
    known length; half the noise. What this arm cannot reach is left out. An instrument that touches no faces has more
    of the same, and half the noise. stays: squared tip error, mm^2, that stays.
    """
    if not (x.size and np.isfinite(x).all()):
        return ()
    data, field, along = bound.information(x), _field(bound, x), bound.tangent(x)

    def judged(information: Array, prior: Array) -> tuple[float, Array]:
        more = np.eye(len(information) - x.size)  # the last unknowns move no tip
        within = None if along is None else block_diag(along, more)
        covariance = posterior_covariance(information, prior, within)[: x.size, : x.size]
        return math.sqrt(float((tip_stds(covariance, field) ** 2).sum(axis=1).mean()) + stays), covariance

    found: dict[str, tuple[float, Array, CureOutcome]] = {}
    for outcome in outcomes(bound, x):
        if np.isfinite(outcome.information).all():
            error, covariance = judged(outcome.information, outcome.prior)
            if outcome.kind not in found or error < found[outcome.kind][0]:  # the best of one kind at several places
                found[outcome.kind] = error, covariance, outcome
    now, _ = judged(data, bound.prior_information)
    same = min(now, found["same"][0]) if "same" in found else now
    made, geometry = [], [j for j, key in enumerate(bound.beside) if not key]
    for kind, (error, covariance, outcome) in found.items():
        if kind == "tilt" and error > SAME * same:  # such as an arm whose tool cannot tilt
            continue
        gains = error < GAIN * (now if kind in ("same", "tool") else same)
        made.append(Cure(outcome.words, outcome.touches, error, gains, covariance[np.ix_(geometry, geometry)]))
    return tuple(sorted(made, key=lambda cure: cure.expected_rms_mm))


def cure_for(bound: ArmProblem, now: Array, found: Sequence[Cure], direction: NullDirection | WeakDirection) -> str:
    """Cure for an uncertain direction, in words: the best that settles it, else the one that helps most.

    bound: the problem whose direction it is. now: covariance of its unknowns (s, s). found: from `cures`, best first.
    """
    along = np.where(bound.datum, 0.0, direction.direction) / np.linalg.norm(direction.direction)
    if not along.any():
        return "none needed"
    along = along / prior_scale(bound)
    before = _spread(now, along)
    left = []
    for cure in found:
        after = _spread(cure.covariance, along)
        left.append((cure, 1.0 if not np.isfinite(after) or before == 0 else after / before))
    for cure, part in sorted(left, key=lambda each: not each[0].recommended):
        if part < SETTLES:
            return cure.words
    best = min(left, key=lambda each: each[1], default=None)
    return NO_CURE if best is None or best[1] > LOWERS else f"{best[0].words} (in part)"


def outcomes(bound: BoundProblem, x: Array) -> Iterator[CureOutcome]:
    """Expected accuracy after each cure at x (n,); the first unknowns are those that the samples share."""
    data, prior = bound.information(x), bound.prior_information
    few = bound.unknowns <= MANY  # to choose among touches takes the cube of their number for each
    try:
        touched = CalibratedCell.of(bound, x) if few else None
    except CasacalError:
        touched = None
    if touched is not None and touched.tilt >= MOST_TILT:  # no such arm is understood
        touched = None
    stds = np.sqrt(np.diagonal(posterior_covariance(data, prior)))
    tool = [j for j in tool_unknowns(bound, x) if bound.units[j] == "mm" and stds[j] > TOOL_STD]
    if tool:  # the samples know its point less well than other means
        measured = prior.copy()
        measured[tool, tool] = np.maximum(prior[tool, tool], 1 / TOOL_STD**2)
        words = f"measure {listed([bound.names[j] for j in tool])} to {TOOL_STD:g} mm by other means"
        yield CureOutcome("tool", words, 0, data, measured)
    if len(bound.samples) > 1:
        for i, name in enumerate(bound.problem.names):  # as much as its rows tell of the shared unknowns now
            without = bound.take(np.flatnonzero(bound.measured.instruments != i))
            more = EXTRA_TOUCHES / max(len(bound.samples[i]), 1)
            information = data + more * (data - without.information(x))
            words = f"{EXTRA_TOUCHES} more samples of the {name}"
            yield CureOutcome(f"same as {name}", words, EXTRA_TOUCHES, information, prior)
        return
    samples = extra_samples(bound, x) if touched is None and few else None
    if touched is None and samples is None:
        ways = (("same", "more samples of the same kind", 1), ("noise", "samples at half the noise", 4))
        for kind, how, weight in ways:
            more = weight * EXTRA_TOUCHES / len(bound.samples[0])
            yield CureOutcome(kind, f"{EXTRA_TOUCHES} {how}", EXTRA_TOUCHES, (1 + more) * data, prior)
        return
    field = _field(bound, x)
    pools: dict[Cell | None, Samples | None] = {None: samples}
    for offer in more_samples(bound.problem) if touched is None else offers(bound, touched):
        if offer.cell not in pools and touched is not None and offer.cell is not None:
            pools[offer.cell] = touched.on(offer.cell)
        pool = pools[offer.cell]
        if pool is None:
            continue
        try:
            extra, stand, before = _with_rows(bound, x, data, offer, pool)
            best = Choice.on_top(extra, stand, before, field).best_of(offer.touches, 1, np.random.default_rng(0))
            after = before + extra.take(best).information(stand)
            kept = pool.take(best)
            yield CureOutcome(
                offer.kind, offer.words, offer.touches, after, extra.prior_information, kept, offer.problem
            )
        except CasacalError:  # such as a plunger that would lie in the face
            continue


def _with_rows(
    bound: BoundProblem, x: Array, data: Array, offer: Offer, rows: Samples
) -> tuple[BoundProblem, Array, Array]:
    """Extra rows (N) of an offer, bound; where they stand (m,); information (m, m) that there is without them.

    x, data: the estimate (n,) and the information of the samples there (n, n). The rows' noise is the noise found times
    a factor. Unknowns that they alone see, such as a new face, come last.
    """
    problem, old = offer.problem, dict[str, Slot]()
    faces, instrument = () if offer.cell is None else offer.cell.faces, problem.instrument
    for slot in bound.slots:  # as the instrument with a face for each label has them
        unknown = instrument.unknowns.get(slot.key)
        if slot.label is None and unknown is not None and unknown.per is not None:
            slot = replace(slot, unknown=unknown, label="plane")
        old[slot.name] = slot
    known, new = {slot.label for slot in old.values()}, list[Slot]()
    strange = {face.label: face for face in faces if face.label not in known}
    own = rows.faces(instrument.groups)
    there = np.flatnonzero(np.isin(own.codes, [k for k, label in enumerate(own.names) if label in strange]))
    for slot in make_slots(problem, [rows.take(there)]) if strange else ():
        if slot.label in strange and slot.unknown.nominal_plane(slot.nominal) is not None:
            face = strange[slot.label]
            slot = replace(slot, nominal=slot.unknown.placed(np.asarray(face.centre), face.axes[0]))
        new += [] if slot.name in old else [slot]
    slots, parts, first = list[Slot](), list[Array](), 0
    for slot in (*old.values(), *new):
        parts.append(x[slot.columns] if slot.name in old else np.zeros(slot.unknown.size))
        slots.append(replace(slot, first=first))
        first += slot.unknown.size
    stand = np.concatenate(parts)
    # the noise of a new face is the mean square of that of the others
    found = list(by_face(bound.scale).values())
    others = math.sqrt(float(np.mean(np.square(found)))) if found else 1.0
    scale = times({OTHERS: others, **bound.scale}, offer.noise)
    information = np.zeros((stand.size, stand.size))
    information[: x.size, : x.size] = data
    made = BoundProblem(problem, tuple(slots), (rows,), "blocks", scale=scale, known=bound.known)
    return made, stand, information


def _field(arm: ArmProblem, at: Array) -> Array:
    """Slopes of the tip over the workspace, apart from the pose of the base (3M, s)."""
    joints = workspace_joints(arm.problem.robot)
    return without_rigid(arm.tip_jacobian(at, joints), arm.tips(at, joints))


def _spread(covariance: Array, along: Array) -> float:
    """Standard deviation of a combination (s,) of unknowns, some of which may be unbounded."""
    lost = ~np.isfinite(np.diagonal(covariance))
    if along[lost].any():
        return float("inf")
    held = np.where(np.isfinite(covariance), covariance, 0.0)
    return math.sqrt(max(float(along @ held @ along), 0.0))


def extra_samples(bound: BoundProblem, x: Array) -> Samples | None:
    """Rows at x (n,) in random postures, with labels as those that there are; None where hardly any can be taken.

    Also None for what touches faces.
    """
    from casacal.simulation.bench import bench_of, exact_rows  # what touches faces needs no bench

    problem, samples, rng = bound.problem.without_terms, bound.samples[0], np.random.default_rng(0)
    if len(bound.samples) > 1 or problem.instrument.probe is not None:
        return None
    stands = {slot.name: x[slot.columns] for slot in bound.slots}
    draw = Draw(0, known=stands, nominals={slot.name: slot.nominal for slot in bound.slots})
    labels = samples.take(rng.integers(len(samples), size=POOL)).labels
    bench = bench_of(problem, Disturbances(error_scale=0.0), labels, rng, POOL, draw)
    found = exact_rows(bench, labels, rng, rounds=ROUNDS)
    return found if len(found) >= FEWEST else None
