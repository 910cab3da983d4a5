"""A calibration in full, as plain text."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

from casacal.calibration.brief import corrected_words, nothing_helps, together
from casacal.calibration.calibration import Calibration
from casacal.calibration.result_json import image_words, verdict_lines
from casacal.calibration.tables import (
    constant_table,
    correlation_table,
    cure_table,
    direction_table,
    effect_table,
    left_out_table,
    parameters_table,
    residual_table,
)
from casacal.calibration.verdict import (
    WithVerdict,
)
from casacal.data.samples import Measurements
from casacal.errors import CasacalError
from casacal.public import __version__
from casacal.wording import METRE, chance, counted, listed, lower, mm

SHOWN_DIRECTIONS = 6
SHOWN_PAIRS = 4
PLANNED = (
    "casacal plan PROBLEM --after SAMPLES plans such touches; a new face or step goes into the problem file first. "
    "Figures here use noise and effects as found, those of plan as stated."
)


def summary(calibration: WithVerdict, name: str) -> str:
    """Plain text of many lines; figures of accuracy are left out when the verdict denies them."""
    verdict, words = calibration.verdict, calibration.fit.problem.words
    reasons = (f"- {reason}" for reason in [*verdict.reasons, *image_words(calibration, verdict)])
    parts = [
        _opening(calibration, name),
        "\n".join([*verdict_lines(calibration, verdict), *reasons]),
        residual_table(calibration).text(),
        f"Each {words.group} by the others:\n{left_out_table(calibration).text()}" if calibration.left_out else "",
        *_of_the_arm(calibration),
        *_beside_the_arm(calibration),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def _opening(calibration: Calibration, name: str) -> str:
    """Arm, method and rows; which result these were taken with, what was loosened, and whether they agree with it."""
    fit, held, measured = calibration.fit, calibration.heldout, Measurements.of(calibration.samples)
    rows = f"{len(fit.measured)} fitted, {'none' if held is None else len(held.measured)} held out"
    rows += "" if held is None else together(calibration)
    if calibration.aside:
        rows += f", {len(calibration.aside_lines)} set aside"
    if calibration.copies:
        rows += f", {calibration.copies} {'copy' if calibration.copies == 1 else 'copies'} left out"
    taken = ""
    if len(measured.sets) > 1:
        taken = "".join(
            f"{len(some)} of the {each}, " for each, some in zip(measured.names, measured.sets, strict=True)
        )
    elif (labels := measured.sets[0].labels.get(column := fit.problem.instrument.groups or "")) is not None:
        groups = len(labels.names)
        taken = f"{groups} {column}{'s' if groups != 1 else ''}, " if groups else ""
    said = (
        f"casacal {__version__}, {fit.problem.robot.name} ({name}), {calibration.method}\n"
        f"{calibration.result.message}\n"
        f"{len(calibration.samples)} samples of {calibration.samples.file}: {rows}; {taken}{fit.unknowns} unknowns"
    )
    if (earlier := calibration.earlier) is None:
        return said
    stds = (name if std is None else f"{name} by {std:g}" for name, std in earlier.loosened.items())
    parts = [f"With what {earlier.file} knows: rows so far from what it expects, {chance(calibration.earlier_chance)}"]
    parts += [f"may have changed: {listed(list(stds))}"] if earlier.loosened else []
    parts += [f"has not moved: {listed(list(earlier.standing))}"] if earlier.standing else []
    parts += [f"{counted(len(earlier.left_out), 'row')} it was calibrated from left out"] if earlier.left_out else []
    return f"{said}\n{'; '.join(parts)}."


def _of_the_arm(calibration: WithVerdict) -> Iterator[str]:
    """Accuracy, what moves the tip most, parameters, and directions that the samples do not show."""
    if not calibration.denied:
        (before, after), (drawn, flange) = calibration.tip_std, calibration.flange_std
        alone, _ = calibration.tip_std_without_prior
        samples_alone = f"the tip error is {mm(alone, 3)} RMS" if alone < METRE else "the tip error has no bound"
        lines = [
            "The residuals above are not accuracy: they can be small while the arm is wrong elsewhere.",
            f"Expected tip error over the workspace, apart from the position of the base: {mm(after, 3)} RMS (before: "
            f"{mm(before, 3)}).",
            *([f"Expected flange error: {mm(flange, 3)} (before: {mm(drawn, 3)})."] if math.isfinite(flange) else []),
            f"Both assume that {calibration.assumed} are right and that nothing else moves the arm.",
            *corrected_words(calibration),
            f"From the samples alone, without priors, {samples_alone}.",
        ]
        yield "\n".join(lines)
        yield _most(calibration)
    table, held = parameters_table(calibration)
    lines = [table.text()] if table.rows else []
    lines += [f"held at nominal: {', '.join(held)}"] if held else []
    if calibration.corrected:
        lines.append(
            "These values belong with the corrected effects. For a controller without them use casacal export."
        )
    yield "\n".join(lines)
    yield _blind_spots(calibration)


def _most(calibration: Calibration) -> str:
    """The rows and the priors that move the tip most; nothing where the estimate is no minimum."""
    try:
        rows, priors = calibration.sensitivity.most()
    except CasacalError:
        return ""
    shown = {
        "rows": [f"line {line} ({mm(tip)})" for line, tip in rows],
        "priors": [f"{name} ({mm(tip)})" for name, tip in priors],
    }
    lines = [f"  {what}: {', '.join(names)}" for what, names in shown.items() if names]
    return "\n".join(["What moves the tip most, by one standard deviation each:", *lines]) if lines else ""


def _blind_spots(calibration: WithVerdict) -> str:
    denied = calibration.denied
    found, (costly, harmless) = calibration.identifiability, direction_table(calibration)
    lines = [
        f"What these samples show: {found.rank} of {found.unknowns} directions of the unknowns, {len(found.weak)} of "
        f"them weakly; {len(found.null)} not at all (null)"
    ]
    for words, kind, tip, cure in costly.rows[:SHOWN_DIRECTIONS]:
        costs = "" if denied else f"{tip} mm at the tip under the prior; "
        lines += [f"  {words} ({kind})", f"      {costs}cure: {lower(cure)}"]
    left = max(SHOWN_DIRECTIONS - len(costly.rows), 0)
    lines += [f"  {words}; moves no tip" for words in harmless[:left]]
    if (more := len(costly.rows) + len(harmless) - SHOWN_DIRECTIONS) > 0:
        lines.append(f"  ... and {more} more of less weight; result.json has them all")
    pairs = [] if denied else correlation_table(calibration).rows
    if pairs:
        shown = ", ".join(f"{one} with {two} ({value})" for one, two, value in pairs[:SHOWN_PAIRS])
        more_pairs = f" and {len(pairs) - SHOWN_PAIRS} more" if len(pairs) > SHOWN_PAIRS else ""
        lines.append(f"  correlated above 0.95: {shown}{more_pairs}")
    return "\n".join(lines)


def _beside_the_arm(calibration: WithVerdict) -> Iterator[str]:
    """Next steps, trusted constants, errors beside the geometry and what became of each correction, the reference."""
    if not calibration.denied and (steps := cure_table(calibration)).rows:
        planned = [PLANNED] if any("planned" in cure.words for cure in calibration.cures) else []
        yield "\n".join([steps.text(), *planned, *filter(None, [nothing_helps(calibration)])])
    if not calibration.denied and calibration.leverages:
        yield constant_table(calibration).text()
    table = effect_table(calibration)
    if table.rows:
        shown = [row for row in table.rows if row[1] == "yes"]
        lines = ["Errors beside the geometry:"]
        lines += [replace(table, rows=shown).text()] if shown else []
        left = len(table.rows) - len(shown)
        lines.append(f"{left}{' more' if shown else ''} looked for and not found; result.json lists them all.")
        outcomes = [each.became for each in calibration.tried if each.unseen]
        yield "\n".join([*lines, *(outcomes or (["None of them is corrected."] if calibration.tried else []))])
    if (reference := calibration.reference) is None:
        yield "Reference: not run."
        return
    yield (
        f"Reference: {reference.solver} {'agrees' if reference.agrees else 'DIFFERS'}; cost "
        f"{calibration.result.cost:.8g}, its cost {reference.cost:.8g} (difference {reference.gap:.1e}, limit "
        f"{reference.limit:.0e}), KKT residual {reference.result.kkt:.1e}, {reference.result.steps} iterations."
        f"{'' if reference.result.converged else f'{chr(10)}{reference.solver}: {reference.result.message}'}"
    )
