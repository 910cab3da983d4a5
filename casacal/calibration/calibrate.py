"""The main job: fit, hold out, compare with before, and cross-check with the reference."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from casacal.calibration.as_arm import AsArm
from casacal.calibration.before_fit import labels_alike
from casacal.calibration.calibrated import Calibrated
from casacal.calibration.finding import Finding
from casacal.calibration.inputs import Method, Progress, Reference, chosen, estimate, problem_from, samples_from
from casacal.calibration.motion import tried_corrections
from casacal.calibration.set_aside import gross
from casacal.data.holdout import split_each
from casacal.data.repeats import without_copies
from casacal.data.samples import Measurements, Samples
from casacal.effects.compliance import LinkSag
from casacal.effects.kit import with_link_kit
from casacal.effects.selection import with_effects
from casacal.effects.trusted import with_constants
from casacal.errors import CasacalError, ProblemError, SamplesError, came
from casacal.fit.arm_alone import bind_further
from casacal.fit.bound_problem import BoundProblem, bind
from casacal.fit.controls import plane_only
from casacal.fit.ipopt import check_solver, nlpsol
from casacal.fit.least_squares import Result
from casacal.fit.lm import lm
from casacal.fit.methods import METHODS
from casacal.kernels.losses import Loss
from casacal.linalg import right_directions
from casacal.model.problem import Problem
from casacal.model.problem_file import ProblemFile
from casacal.uncertainty.noise import found_noise
from casacal.values import Array
from casacal.wording import counted, listed

if TYPE_CHECKING:
    from casacal.calibration.earlier import RowsSince
    from casacal.deployment.arm import CalibratedArm

_LOG = logging.getLogger("casacal")
TRIED = 100  # steps within which a fit of an arm ends, twenty times what it needs, unless nothing holds its unknowns
UNSEEN = 1e-9  # singular value over the largest below which a direction is hidden by rounding


def calibrate(
    problem: Problem | ProblemFile | str | Path,
    samples: Samples | Mapping[str, Any] | str | Path | Any = None,
    *,
    method: str | Method | None = None,
    holdout: float = 0.0,
    holdout_by: str = "rows",
    seed: int = 0,
    reference: bool | str = True,
    noise: Literal["found", "stated"] = "found",
    outliers: Literal["set aside", "keep"] = "set aside",
    discrepancy: Literal["kit", "none"] = "kit",
    loss: Loss | None = None,
    prior: AsArm | CalibratedArm | str | Path | None = None,
    loosen: Collection[str] | Mapping[str, float | None] = (),
    standing: Collection[str] = (),
    backend: str | None = None,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Calibrated:
    """Fit the unknowns of a problem to its samples.

    Args:
        problem: robot and instruments: a `Problem`, what `load_problem` returns, or the path of a problem.
        samples: rows of the instrument: `Samples`, a file, a pandas DataFrame, or arrays by column; by default the
            samples.csv beside a problem file. Of several instruments these by name, such as {"dial": "a.csv",
            "tracker": "b.csv"}; by default samples-dial.csv and so on.
        method: a name of `METHODS`, or a function of the least-squares problem that returns a `Result`, or x (n,); by
            default "sckf-lm", and "lm" with a loss.
        holdout: fraction of the rows (0 to below 1) that is not fitted but judged.
        holdout_by: what is held out together: "rows" of each face one by one, "region" (on each face the nearest
            postures to one), "face" (whole faces, whose places are then fitted to their own rows), or a column of the
            samples, such as one of sessions: all rows of some of its values.
        seed: of the choice of those rows, and of methods that draw random numbers.
        reference: whether an independent solver checks the minimum, or which of CasADi's nlpsol plug-ins does, such as
            "fatrop"; by default "ipopt". It minimises the same cost, with the loss where there is one.
        noise: "found" takes what was stated for the least and what the rows show on top of it into every weight and
            interval; "stated" trusts what was stated.
        outliers: "set aside" fits without the rows that chance does not explain, where they are few, and names them;
            "keep" fits all. With a robust loss all are kept. Copies of a row always count once.
        discrepancy: "kit" takes non-geometric effects into account: the problem's own, or
            those to expect of any arm; "none" takes geometry for all there is, and instruments for perfect, as methods
            that search a box and thousands of faces do. Beside a robust loss only constants of instruments may err.
        loss: a robust loss, such as `huber()`, for methods that minimise: all but filters and "plane-only".
        prior: an earlier result of this arm: all that it knows, with its covariance, its effects and its noise, is what
            is known before these rows. They alone would tell less, and need be few. Faces are fitted anew.
        loosen: what may have changed since, with `prior`: joints ("joint3"), unknowns ("theta3") or keys ("tool"), and
            by how much ({"theta": 2e-5}, standard deviations in rad and mm; without, anywhere).
        standing: labels of faces or unknowns that stand where the earlier calibration found them.
        backend, threads: what evaluates the rows, as for `bind`.
        progress: called with (step, cost) now and then.

    Returns:
        The calibration as a value: estimate `x` (n,) in mm and rad, figures in mm, tables, pictures, predictions,
        files.

    Raises CasacalError for what is none of these, UnknownNameError for the method, SamplesError when samples do not fit
    the problem or too few remain, ProblemError as `bind` does.

    """
    source = problem_from(problem)
    rows = samples_from(samples, source)
    run, name = chosen(method, loss)
    _check_words(noise, outliers, discrepancy)
    solver, began = _reference(reference), time.perf_counter()
    since = _opened(prior, source, rows, loosen, standing, loss)
    single = Measurements.of(rows if since is None else since.opened.rows).map(without_copies)
    fitted, held = split_each(single, holdout, seed, holdout_by, [each.groups for each in source.problem.instruments])
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):  # a status says what is not finite
        taken = single.take(fitted) if held.size else single
        set_aside, find_noise, kit = outliers == "set aside" and loss is None, noise == "found", discrepancy == "kit"
        if since is not None:
            fit, bare, aside = since.bound(
                taken.sets[0], set_aside=set_aside, noise=find_noise, kit=kit, backend=backend, threads=threads
            )
        else:
            more = _beside(name, kit, loss)
            fit, bare, aside = _from_drawing(source.problem, taken, set_aside, find_noise, more, loss, backend, threads)
        if not source.problem.terms and any(isinstance(each, LinkSag) for each in fit.problem.terms):
            source = replace(source, problem=with_link_kit(source.problem))  # a result names effects that are not usual
        heldout = bind_further(fit, *single.take(held).sets) if held.size else None
        built = time.perf_counter()
        _LOG.info("%s: %d rows bound, %d unknowns", name, fit.rows, bare.unknowns)
        result = estimate(run, name, fit, seed, loss, progress)
        solved = time.perf_counter()
        _LOG.info("%s: %s Cost %.10g after %d steps", name, result.message, result.cost, result.steps)
        tried = tried_corrections(fit, result) if since is None else since.result.tried(fit, result)
        before, checked = plane_only(fit), _check(fit, name, result, solver) if solver else None
    seconds = {"build": built - began, "solve": solved - built, "total": time.perf_counter() - began}
    found = (name, seed, rows, fit, heldout, result, before, checked, seconds, source, aside, holdout_by, tried, bare)
    return Calibrated(*found, None if since is None else since.result)


def calibration_of(
    bound: BoundProblem, x: Result | Array, *, method: str = "own", reference: bool | str = True
) -> Calibrated:
    """The answer of a program of one's own as a calibration: judged, reported and exported as any other.

    What the rows state is taken as it stands: noise, all rows, no effects but those of the problem. The error to expect
    is the posterior's there and, on top of it, the way from the answer to the minimum.

    Args:
        bound: rows as `bind` joins them to a problem.
        x: estimate (n,) of its unknowns, mm and rad, or a `Result`.
        method: what the program is called.
        reference: as for `calibrate`.

    Raises CasacalError for what is none of these.

    """
    if not isinstance(bound, BoundProblem):
        raise CasacalError(f"Got {came(bound)} as the bound problem", "Give what bind(problem, samples) returns")
    began, solver = time.perf_counter(), _reference(reference)
    result = estimate(lambda _: x, method, bound, 0, None, None)
    checked = _check(bound, method, result, solver) if solver else None
    tried, source, rows = tried_corrections(bound, result), problem_from(bound.problem), bound.measured.plain
    seconds = {"build": 0.0, "solve": 0.0, "total": time.perf_counter() - began}
    return Calibrated(method, 0, rows, bound, None, result, plane_only(bound), checked, seconds, source, tried=tried)


def _beside(method: str, kit: bool, loss: Loss | None) -> Literal["effects", "constants", "nothing"]:
    """What may err beside the geometry: the arm by its effects, or instruments alone; no loss makes a dial perfect."""
    if not kit or (method in METHODS and METHODS[method].parameters_only):
        return "nothing"
    return "effects" if loss is None else "constants"


def _from_drawing(
    problem: Problem,
    rows: Measurements,
    set_aside: bool,
    find_noise: bool,
    beside: Literal["effects", "constants", "nothing"],
    loss: Loss | None,
    backend: str | None,
    threads: int | None,
) -> tuple[BoundProblem, BoundProblem, tuple[Finding, ...]]:
    """Rows as they are fitted where the drawing is all that is known, under the geometry alone, and what is wrong."""

    def with_noise(bare: BoundProblem) -> BoundProblem:
        scale = found_noise(bare, loss).scale if find_noise else {}
        return bare.with_noise(scale) if scale else bare

    def whole_of(bare: BoundProblem) -> BoundProblem:
        if beside == "effects":
            return with_effects(bare, problem, find_noise=find_noise)
        unsure = with_constants(bare.problem) if beside == "constants" and bare.unknowns else bare.problem
        return bare if unsure is bare.problem else bare.under(unsure)

    bare, aside = _bound(problem, rows, set_aside, backend, threads)
    bare = with_noise(bare)
    fit = whole_of(bare)
    if fit is bare or not set_aside:
        return fit, bare, aside
    # geometry alone takes smooth errors for noise, in which single rows hide, and calls rows gross that err together:
    # so a second look, with effects and noise known
    try:
        whole = _same(rows, fit.measured)
        bad, found = gross(fit if whole else fit.on(*rows.sets), drawn=bare if whole else bare.on(*rows.sets))
    except ProblemError:  # a face all of whose rows were set aside
        return fit, bare, aside
    kept = rows.take(np.flatnonzero(~bad)) if bad.any() else rows
    if _same(kept, bare.measured):
        return fit, bare, aside
    bare = with_noise(bind(bare.problem, *kept.sets, backend=bare.backend, threads=threads))
    return whole_of(bare), bare, found


def _opened(
    prior: Any,
    source: ProblemFile,
    rows: Samples | Measurements,
    loosen: Collection[str] | Mapping[str, float | None],
    standing: Collection[str],
    loss: Loss | None,
) -> RowsSince | None:
    """The earlier result that these rows are to be taken with; None where there is none."""
    if prior is None:
        if loosen or standing:
            raise CasacalError("Got what to loosen or what stands, without an earlier result", "Give prior=result")
        return None
    from casacal.calibration.earlier import earlier

    if isinstance(rows, Measurements):
        fix = "Calibrate with the old and the new rows together"
        raise CasacalError("An earlier result is a prior of the rows of one instrument", fix)
    if loss is not None:
        raise CasacalError("Got a loss beside an earlier result", "Leave the loss out: gross rows are set aside")
    return earlier(prior, source, rows, loosen=loosen, standing=standing)


def _check_words(noise: str, outliers: str, discrepancy: str) -> None:
    """Raise CasacalError for a word that is none of those that there are."""
    for word, what, one, other in (
        (noise, "as the noise", "found", "stated"),
        (outliers, "for the outliers", "set aside", "keep"),
        (discrepancy, "for the discrepancy", "kit", "none"),
    ):
        if word not in (one, other):
            raise CasacalError(f"Got {came(word)} {what}", f"Give '{one}' or '{other}'")


def _bound(
    problem: Problem, rows: Measurements, aside: bool, backend: str | None, threads: int | None
) -> tuple[BoundProblem, tuple[Finding, ...]]:
    """Rows under the geometry alone, and what is wrong with those set aside; errors for few rows, or no end of fits."""
    try:
        bare = bind(problem.without_terms, *rows.sets, backend=backend, threads=threads)
    except CasacalError as error:
        for slip in labels_alike(problem, rows)[:1]:
            raise ProblemError(f"{error.what}; {slip.cause}", f"{slip.fix}. {error.fix}") from None
        raise
    if bare.rows < bare.unknowns:
        least = -(-bare.unknowns * len(bare.measured) // bare.rows)
        fix = f"Take at least {least} samples, better twice as many, hold fewer out, or hold parameters with --fix"
        raise SamplesError(bare.measured.file, f"{bare.rows} rows are fitted for {bare.unknowns} unknowns", fix)
    flat = {j: name for name, _, _, j in bare.parameters() if j is not None and not math.isfinite(bare.prior_std[j])}
    if flat and lm(bare, max_steps=TRIED).steps >= TRIED:
        from scipy.linalg import qr

        sizes, right = right_directions(np.vstack([bare.compact_jacobian(bare.x0), bare.prior_rows]) * bare.start_std)
        lost = right[sizes <= UNSEEN * sizes[0]]
        _, kept, order = qr(lost[:, list(flat)], pivoting=True)  # one name a direction: holding these is enough
        if names := [list(flat.values())[k] for k in order[: int((np.abs(np.diagonal(kept)) > UNSEEN).sum())]]:
            many = counted(len(names), "combination")
            what = f"Neither the samples nor a prior hold {many} of parameters, so no fit ends"
            raise ProblemError(what, f"Give a prior to {listed(names)} (--prior {names[0]}=STD), or hold them (--fix)")
    bad, found = gross(bare) if aside else (np.zeros(0, dtype=bool), ())
    if bad.any():
        bare = bind(bare.problem, *rows.take(np.flatnonzero(~bad)).sets, backend=backend, threads=threads)
    return bare, found


def _same(one: Measurements, two: Measurements) -> bool:
    """Whether these are the same rows."""
    return all(a.lines == b.lines for a, b in zip(one.sets, two.sets, strict=True))


def _reference(requested: bool | str) -> str:
    """The plug-in that is to check the minimum; empty where none is."""
    if requested is False:
        return ""
    solver = "ipopt" if requested is True else requested
    check_solver(solver)
    return solver


def _check(fit: BoundProblem, method: str, result: Result, solver: str) -> Reference:
    """Solve again by other means, with the same loss: an nlpsol plug-in or, when that is the method, LM."""
    solver, loss = "lm" if method == solver else solver, result.loss
    other = lm(fit, loss=loss) if solver == "lm" else nlpsol(fit, solver=solver, loss=loss)
    own = other.trace.get("cost", np.zeros(0))
    cost = float(own[-1]) if own.size else other.cost
    return Reference(solver, other, cost, (result.cost - cost) / max(cost, 1e-300))
