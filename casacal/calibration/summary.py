"""All that is said of a calibration, as text: verdict, residuals, accuracy, parameters, blind spots, reference."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from casacal.calibration.brief import nothing_helps, together
from casacal.calibration.calibration import NOT_NEEDED, Calibration
from casacal.calibration.doubts import corrected_words, size_words, tried_words
from casacal.calibration.metrics import parts_of
from casacal.calibration.result_parts import parameter_rows
from casacal.calibration.verdict import verdict_of
from casacal.samples.measurements import Measurements
from casacal.uncertainty.identifiability import KNOWN_FROM, NullDirection, WeakDirection, correlated_pairs
from casacal.version import __version__
from casacal.wording import METRE, mm

SHOWN_DIRECTIONS = 6
SHOWN_PAIRS = 4
PLANNED = (
    "casacal plan PROBLEM --after SAMPLES plans such touches; a new face or step goes into the problem file first. "
    "Figures here use noise and effects as found, those of plan as stated."
)


def summary(calibration: Calibration, name: str) -> str:
    """Plain text of many lines; figures of accuracy are left out when the verdict denies them."""
    calibration, verdict = calibration.unjudged, verdict_of(calibration)
    denied = verdict.level == "do not use"
    parts = [
        _opening(calibration, name),
        "\n".join([verdict.words, *(f"- {reason}" for reason in verdict.reasons)]),
        _residuals(calibration),
        _left_out(calibration, denied),
        "" if denied else _accuracy(calibration),
        parameter_table(calibration),
        _blind_spots(calibration, denied),
        "" if denied else _cures(calibration),
        _beside(calibration, denied),
        _reference(calibration),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def parameter_table(calibration: Calibration) -> str:
    """Nominal, change, estimate and standard deviation of each free parameter, with what determined it.

    Angles are shown in degrees, lengths in mm.
    """
    denied = verdict_of(calibration).level == "do not use"
    rows = parameter_rows(calibration.fit, calibration.used_x, calibration.result.std, denied=denied)
    wide = max(12, *(len(row["name"]) + 2 for row in rows)) if rows else 12
    lines = [f"{'parameter':<{wide}}{'unit':<5}{'nominal':>13}{'estimate':>13}{'change':>11}{'std':>10}  known from"]
    held = []
    for row in rows:
        if row["note"] == "held at nominal":
            held.append(row["name"])
            continue
        unit, factor = ("deg", 180 / math.pi) if row["unit"] == "rad" else (row["unit"], 1.0)
        nominal, estimate, std = (factor * row[key] for key in ("nominal", "estimate", "std"))
        lines.append(
            f"{row['name']:<{wide}}{unit:<5}{nominal:>13.4f}{estimate:>13.4f}{estimate - nominal:>+11.4f}"
            f"{'-' if denied else f'{std:.4f}':>10}"
            f"  {KNOWN_FROM[row['identifiable']]}"
        )
    if held:
        lines.append(f"held at nominal: {', '.join(held)}")
    if calibration.corrected:
        lines.append(
            "These values belong with the corrected effects. For a controller without them use casacal export."
        )
    return "\n".join(lines)


def _opening(calibration: Calibration, name: str) -> str:
    fit, held = calibration.fit, calibration.heldout
    rows = f"{len(fit.measured)} fitted, {'none' if held is None else len(held.measured)} held out"
    rows += "" if held is None else together(calibration)
    if calibration.aside:
        rows += f", {len(calibration.aside_lines)} set aside"
    if calibration.copies:
        rows += f", {calibration.copies} {'copy' if calibration.copies == 1 else 'copies'} left out"
    return (
        f"casacal {__version__}, {fit.problem.robot.name} ({name}), {calibration.method}\n"
        f"{calibration.result.message}\n"
        f"{len(calibration.samples)} samples of {calibration.samples.file}: {rows}; "
        f"{_counted(calibration)}{fit.unknowns} unknowns"
    )


def _counted(calibration: Calibration) -> str:
    """How many faces there are, or how many samples each instrument took."""
    given = Measurements.of(calibration.samples)
    if len(given.sets) > 1:
        return "".join(f"{len(some)} of the {name}, " for name, some in zip(given.names, given.sets, strict=True))
    column = calibration.fit.problem.instrument.groups or ""
    groups = len(given.sets[0].labels[column].names) if column in given.sets[0].labels else 0
    return f"{groups} {column}{'s' if groups != 1 else ''}, " if groups else ""


def _residuals(calibration: Calibration) -> str:
    said = calibration.fit.problem.words
    title = f"{said.residual}, {said.unit}"
    lines = [f"{title:<32}{'RMSE':>9}{'MAE':>9}{'STD':>9}{'MAX':>9}"]
    words = {"before": f"before ({said.before})", "after": "after"}
    of_each, units = calibration.metrics_by_instrument, parts_of(calibration.fit)
    for name, metrics in (of_each or {"": calibration.metrics}).items():
        other = f" ({units[name]})" if name and units[name] != said.unit else ""
        of = f"{name}{other}, " if name else ""
        for when, parts in metrics.items():
            for part, figures in parts.items():
                if figures is not None:
                    shown = when if of_each else words[when]
                    label = f"  {of}{shown if part == 'fit' else when + ', held out'}"
                    lines.append(f"{label:<32}" + _figures(figures))
    return "\n".join(lines)


def _left_out(calibration: Calibration, denied: bool) -> str:
    faces = calibration.left_out
    if not faces:
        return ""
    words = calibration.fit.problem.words
    title = f"each {words.group} by the others, {words.unit} RMS"
    lines = [f"{title:<41}{'found':>9}" + ("" if denied else f"{'predicted':>11}{'ratio':>8}")]
    for face in faces:
        predicted = "" if denied else f"{face.predicted_mm:>11.4f}{face.ratio:>8.2f}"
        lines.append(f"  {face.face:<39}{face.actual_mm:>9.4f}{predicted}")
    return "\n".join(lines)


def _figures(figures: Mapping[str, Any]) -> str:
    return "".join(f"{figures[key]:>9.4f}" for key in ("rmse_mm", "mae_mm", "std_mm", "max_mm"))


def _accuracy(calibration: Calibration) -> str:
    (before, after), (drawn, flange) = calibration.tip_std, calibration.flange_std
    alone, _ = calibration.tip_std_without_prior
    samples_alone = f"the tip error is {mm(alone, 3)} RMS" if alone < METRE else "the tip error has no bound"
    return "\n".join(
        [
            "The residuals above are not accuracy: they can be small while the arm is wrong elsewhere.",
            f"Expected tip error over the workspace, apart from the position of the base: {mm(after, 3)} RMS (before: "
            f"{mm(before, 3)}).",
            *([f"Expected flange error: {mm(flange, 3)} (before: {mm(drawn, 3)})."] if math.isfinite(flange) else []),
            f"Both assume that {calibration.assumed} are right and that nothing else moves the arm.",
            *corrected_words(calibration),
            f"From the samples alone, without priors, {samples_alone}.",
        ]
    )


def _blind_spots(calibration: Calibration, denied: bool) -> str:
    found = calibration.identifiability
    lines = [
        f"What these samples show: {found.rank} of {found.unknowns} directions of the unknowns, {len(found.weak)} of "
        f"them weakly; {len(found.null)} not at all (null)"
    ]
    named: list[tuple[float, str]] = []
    directions: tuple[NullDirection | WeakDirection, ...] = (*found.null, *found.weak)
    for direction, cure in zip(directions, calibration.advice, strict=True):
        kind = direction.kind if isinstance(direction, NullDirection) else "weak"
        text = f"  {kind + ':':<11}{direction.words}"
        if cure != NOT_NEEDED:
            costs = "" if denied else f"{mm(direction.tip_mm)} at the tip under the prior; "
            text += f"\n{'':<13}{costs}cure: {cure}"
        named.append((direction.tip_mm, text))
    named.sort(key=lambda entry: -entry[0])  # the costly ones first
    lines += [text for _, text in named[:SHOWN_DIRECTIONS]]
    if len(named) > SHOWN_DIRECTIONS:
        lines.append(f"  ... and {len(named) - SHOWN_DIRECTIONS} more of less weight; result.json has them all")
    arm = np.flatnonzero(~calibration.seen.datum)  # planes are always correlated with each other and with the base
    names = [calibration.seen.names[j] for j in arm]
    pairs = [] if denied else correlated_pairs(calibration.covariance[np.ix_(arm, arm)], names)
    if pairs:
        shown = ", ".join(f"{one} with {two} ({value:+.2f})" for one, two, value in pairs[:SHOWN_PAIRS])
        more = f" and {len(pairs) - SHOWN_PAIRS} more" if len(pairs) > SHOWN_PAIRS else ""
        lines.append(f"  correlated above 0.95: {shown}{more}")
    return "\n".join(lines)


def _cures(calibration: Calibration) -> str:
    """What to do next, best first; what gains little, or hardly more than touches of the same kind, is marked."""
    if not calibration.cures:
        return ""
    lines = ["What to do next, best first, with the tip error to expect afterwards:"]
    for cure in calibration.cures:
        said = f"{mm(cure.expected_rms_mm, 3):>11}  {cure.words}"
        lines.append(said if cure.recommended else f"{said} (not recommended)")
    lines.append(f"{mm(calibration.tip_std[1], 3):>11}  as it is")
    if any("planned" in cure.words for cure in calibration.cures):
        lines.append(PLANNED)
    if none := nothing_helps(calibration):
        lines.append(none)
    return "\n".join(lines)


def _beside(calibration: Calibration, denied: bool) -> str:
    """What the rows show beside the geometry; the likeliest first, and how many more were looked for."""
    tests = calibration.score_tests
    if not tests:
        return ""
    shown = [test for test in tests if test.shown != "no"]
    lines = ["Errors beside the geometry (each as if it were the only one):"]
    if shown:
        wide = max(len(test.words) for test in shown)
        tip = "" if denied else f"{'at the tip':>12}"
        lines.append(f"  {'':<{wide}}  {'shown':<9}{'p':>9}{'size':>24}{tip}")
    for test in shown:
        size, at_tip = size_words(calibration, test)
        tip = "" if denied else f"{at_tip:>12}"
        lines.append(f"  {test.words:<{wide}}  {test.shown:<9}{test.p_holm:>9.1g}{size:>24}{tip}")
    left = len(tests) - len(shown)
    lines.append(f"  {left}{' more' if shown else ''} looked for and not found; result.json lists them all.")
    return "\n".join([*lines, *tried_words(calibration)])


def _reference(calibration: Calibration) -> str:
    reference = calibration.reference
    if reference is None:
        return "Reference: not run" + ("; IPOPT knows no robust loss." if calibration.result.loss else ".")
    verdict = "agrees" if reference.agrees else "DIFFERS"
    words = (
        f"Reference: {reference.solver} {verdict}; cost {calibration.result.cost:.8g}, its cost {reference.cost:.8g} "
        f"(difference {reference.gap:.1e}, limit {reference.limit:.0e}), KKT residual {reference.result.kkt:.1e}, "
        f"{reference.result.steps} iterations."
    )
    return words if reference.result.converged else f"{words}\n{reference.solver}: {reference.result.message}"
