"""All that is said of a calibration, as text: verdict, residuals, accuracy, parameters, blind spots, reference."""

from __future__ import annotations

import math
from dataclasses import replace

from casacal.calibration import tables
from casacal.calibration.brief import nothing_helps, together
from casacal.calibration.calibration import Calibration
from casacal.calibration.told import verdict_lines
from casacal.calibration.verdict import verdict_of
from casacal.errors import CasacalError
from casacal.samples.samples import Measurements
from casacal.version import __version__
from casacal.wording import METRE, chance, counted, listed, lower, mm

SHOWN_DIRECTIONS = 6
SHOWN_PAIRS = 4
PLANNED = (
    "casacal plan PROBLEM --after SAMPLES plans such touches; a new face or step goes into the problem file first. "
    "Figures here use noise and effects as found, those of plan as stated."
)


def summary(calibration: Calibration, name: str) -> str:
    """Plain text of many lines; figures of accuracy are left out when the verdict denies them."""
    verdict = verdict_of(calibration)
    denied = verdict.level == "do not use"
    parts = [
        _opening(calibration, name),
        "\n".join([*verdict_lines(calibration, verdict), *(f"- {reason}" for reason in verdict.reasons)]),
        tables.residuals(calibration).text(),
        _left_out(calibration),
        "" if denied else _accuracy(calibration),
        "" if denied else _most(calibration),
        _parameters(calibration),
        _blind_spots(calibration, denied),
        "" if denied else _next_steps(calibration),
        _beside(calibration),
        _reference(calibration),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


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
        f"{_counted(calibration)}{fit.unknowns} unknowns{_since(calibration)}"
    )


def _since(calibration: Calibration) -> str:
    """Which result these rows were taken with, what was loosened, and whether they agree with it."""
    earlier = calibration.earlier
    if earlier is None:
        return ""
    stds = (name if std is None else f"{name} by {std:g}" for name, std in earlier.loosened.items())
    parts = [
        f"\nWith what {earlier.file} knows: rows so far from what it expects, {chance(calibration.earlier_chance)}"
    ]
    parts += [f"may have changed: {listed(list(stds))}"] if earlier.loosened else []
    parts += [f"has not moved: {listed(list(earlier.standing))}"] if earlier.standing else []
    parts += [f"{counted(len(earlier.left_out), 'row')} it was calibrated from left out"] if earlier.left_out else []
    return "; ".join(parts) + "."


def _counted(calibration: Calibration) -> str:
    """How many faces there are, or how many samples each instrument took."""
    given = Measurements.of(calibration.samples)
    if len(given.sets) > 1:
        return "".join(f"{len(some)} of the {name}, " for name, some in zip(given.names, given.sets, strict=True))
    column = calibration.fit.problem.instrument.groups or ""
    groups = len(given.sets[0].labels[column].names) if column in given.sets[0].labels else 0
    return f"{groups} {column}{'s' if groups != 1 else ''}, " if groups else ""


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
            *tables.corrected_words(calibration),
            f"From the samples alone, without priors, {samples_alone}.",
        ]
    )


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


def _left_out(calibration: Calibration) -> str:
    if not calibration.left_out:
        return ""
    title = f"Each {calibration.fit.problem.words.group} by the others:"
    return f"{title}\n{tables.left_out(calibration).text()}"


def _parameters(calibration: Calibration) -> str:
    table, held = tables.parameters(calibration)
    lines = [table.text()] if table.rows else []
    lines += [f"held at nominal: {', '.join(held)}"] if held else []
    if calibration.corrected:
        lines.append(
            "These values belong with the corrected effects. For a controller without them use casacal export."
        )
    return "\n".join(lines)


def _blind_spots(calibration: Calibration, denied: bool) -> str:
    found, (costly, harmless) = calibration.identifiability, tables.directions(calibration)
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
    pairs = [] if denied else tables.correlations(calibration).rows
    if pairs:
        shown = ", ".join(f"{one} with {two} ({value})" for one, two, value in pairs[:SHOWN_PAIRS])
        more_pairs = f" and {len(pairs) - SHOWN_PAIRS} more" if len(pairs) > SHOWN_PAIRS else ""
        lines.append(f"  correlated above 0.95: {shown}{more_pairs}")
    return "\n".join(lines)


def _next_steps(calibration: Calibration) -> str:
    table = tables.next_steps(calibration)
    if not table.rows:
        return ""
    planned = [PLANNED] if any("planned" in cure.words for cure in calibration.cures) else []
    return "\n".join([table.text(), *planned, *filter(None, [nothing_helps(calibration)])])


def _beside(calibration: Calibration) -> str:
    """Non-geometric effects that the rows show, and what became of each correction that was tried."""
    table = tables.effects(calibration)
    if not table.rows:
        return ""
    shown = [row for row in table.rows if row[1] == "yes"]
    lines = ["Errors beside the geometry:"]
    lines += [replace(table, rows=shown).text()] if shown else []
    left = len(table.rows) - len(shown)
    lines.append(f"{left}{' more' if shown else ''} looked for and not found; result.json lists them all.")
    asked = [each.became for each in calibration.tried if each.unseen]
    none = ["None of them is corrected."] if calibration.tried else []
    return "\n".join([*lines, *(asked or none)])


def _reference(calibration: Calibration) -> str:
    reference = calibration.reference
    if reference is None:
        return "Reference: not run."
    verdict = "agrees" if reference.agrees else "DIFFERS"
    words = (
        f"Reference: {reference.solver} {verdict}; cost {calibration.result.cost:.8g}, its cost {reference.cost:.8g} "
        f"(difference {reference.gap:.1e}, limit {reference.limit:.0e}), KKT residual {reference.result.kkt:.1e}, "
        f"{reference.result.steps} iterations."
    )
    return words if reference.result.converged else f"{words}\n{reference.solver}: {reference.result.message}"
