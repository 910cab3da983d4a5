"""A calibration in full, as plain text; and the tables that its report has as well."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.calibration.brief import corrected_words, nothing_helps, together
from casacal.calibration.calibration import NOT_NEEDED, Calibration, parts_of
from casacal.calibration.result_json import image_words, parameter_rows, verdict_lines
from casacal.calibration.verdict import WithVerdict
from casacal.data.samples import Measurements
from casacal.errors import CasacalError
from casacal.pages.drawing import fixed, shortened, shown_unit
from casacal.pages.drawing import mm as in_mm
from casacal.public import __version__
from casacal.uncertainty.identifiability import NullDirection, correlated_pairs
from casacal.wording import METRE, capital, chance, counted, listed, lower, mm, sized

SHOWN_DIRECTIONS = 6
SHOWN_PAIRS = 4
PLANNED = (
    "casacal plan PROBLEM --after SAMPLES plans such touches; a new face or step goes into the problem file first. "
    "Figures here use noise and effects as found, those of plan as stated."
)
LONGEST = 60  # characters of a face's name


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
        pairs = zip(measured.names, measured.sets, strict=True)
        taken = "".join(f"{len(some)} of the {each}, " for each, some in pairs)
    elif (labels := measured.sets[0].labels.get(column := fit.problem.instrument.groups or "")) is not None:
        groups = len(labels.names)
        taken = f"{groups} {column}{'s' if groups != 1 else ''}, " if groups else ""
    said = f"casacal {__version__}, {fit.problem.robot.name} ({name}), {calibration.method}\n"
    said += f"{calibration.result.message}\n"
    said += f"{len(calibration.samples)} samples of {calibration.samples.file}: {rows}; {taken}{fit.unknowns} unknowns"
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
            f"Expected tip error over the workspace, apart from the pose of the base: {mm(after, 3)} RMS (before: "
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
        lines += ["These values belong with the corrected effects. For a controller without them use casacal export."]
    yield "\n".join(lines)
    yield _blind_spots(calibration)


def _most(calibration: Calibration) -> str:
    """The rows and the priors that move the tip most; nothing where the estimate is no minimum."""
    try:
        rows, priors = calibration.sensitivity.most()
    except CasacalError:
        return ""
    shown = (("rows", [(f"line {line}", tip) for line, tip in rows]), ("priors", priors))
    lines = [f"  {what}: {', '.join(f'{name} ({mm(tip)})' for name, tip in each)}" for what, each in shown if each]
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
    lines += [f"  {words}; moves no tip" for words in harmless[: max(SHOWN_DIRECTIONS - len(costly.rows), 0)]]
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


@dataclass(frozen=True)
class PrintedTable:
    """Rows of text under titles; a title that begins with # heads a column of numbers."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def text(self) -> str:
        """Lines in columns as wide as they must be, in characters that every terminal has."""
        titles = [title.removeprefix("#") for title in self.columns]
        wide = [max(map(len, column)) for column in zip(titles, *self.rows, strict=True)]
        sides = [">" if title.startswith("#") else "<" for title in self.columns]
        lines = []
        for row in (titles, *self.rows):
            cells = zip(row, sides, wide, strict=True)
            lines.append("  ".join(f"{cell:{side}{width}}" for cell, side, width in cells).rstrip())
        return "\n".join(lines).replace("–", "-")


def residual_table(calibration: Calibration) -> PrintedTable:
    """RMSE, MAE, STD and MAX before and after, of fitted and held-out rows, of each of several instruments."""
    words, units = calibration.fit.problem.words, parts_of(calibration.fit)
    rows = []
    for name, metrics in (calibration.metrics_by_instrument or {"": calibration.metrics}).items():
        other = "" if not name or units[name] == words.unit else f" ({units[name]}, not {words.unit})"
        for when, parts in metrics.items():
            for part, of_rows in (("fit", "fitted rows"), ("heldout", "held-out rows")):
                if (found := parts[part]) is not None:
                    label = f"{name}{other}: {when}" if name else capital(when)
                    figures = (fixed(found[key]) for key in ("rmse_mm", "mae_mm", "std_mm", "max_mm"))
                    rows.append([f"{label}, {of_rows}", *figures])
    figures_of = [f"#{figure}, {words.unit}" for figure in ("RMSE", "MAE", "STD", "MAX")]
    return PrintedTable([capital(words.residual), *figures_of], rows)


def left_out_table(calibration: Calibration) -> PrintedTable:
    """Each face left out: found and predicted residuals, mm RMS; no prediction where it is denied."""
    predicts = any(math.isfinite(face.predicted_mm) for face in calibration.left_out)
    rows = []
    for face in calibration.left_out:
        predicted = [fixed(face.predicted_mm), fixed(face.ratio, 2)] if predicts else []
        label = shortened(face.face, LONGEST)
        rows.append([label, f"{face.rows:,}", fixed(face.actual_mm), *predicted, f"{face.p:.2g}"])
    titles = ["#Predicted, mm RMS", "#Found over predicted"] if predicts else []
    group = capital(calibration.fit.problem.words.group)
    return PrintedTable([group, "#Rows", "#Found, mm RMS", *titles, "#p"], rows)


def parameters_table(calibration: Calibration) -> tuple[PrintedTable, list[str]]:
    """Every free parameter, nominal and calibrated, angles in degrees; and the names of those that are held."""
    priors = dict(zip(calibration.fit.names, calibration.fit.prior_std.tolist(), strict=True))
    held, rows = [], []
    for row in parameter_rows(calibration):
        if row["known_from"] == "held":
            held.append(row["name"])
            continue
        unit, factor = shown_unit(row["unit"])
        nominal, estimate, std = (factor * row[key] for key in ("nominal", "estimate", "std"))
        prior = priors.get(row["name"], math.inf)
        share = f"{100 * row['std'] / prior:.0f} %" if math.isfinite(prior) and math.isfinite(std) else "no prior"
        spread = ["–", "–"] if math.isnan(std) else [fixed(std), share]
        change = fixed(estimate - nominal, signed=True)
        rows.append([row["name"], unit, fixed(nominal), fixed(estimate), change, *spread, row["known_from"]])
    titles = ("Parameter", "Unit", "#Nominal", "#Calibrated", "#Change", "#Std. dev.", "#Of prior", "Known from")
    return PrintedTable(titles, rows), held


def correlation_table(calibration: Calibration) -> PrintedTable:
    """Pairs of the arm's own unknowns: planes are always correlated with each other and with the base."""
    arm = np.flatnonzero(~calibration.seen.datum)
    names = [calibration.seen.names[j] for j in arm]
    pairs = correlated_pairs(calibration.covariance[np.ix_(arm, arm)], names)
    rows = [[one, two, fixed(value, 3, signed=True)] for one, two, value in pairs]
    return PrintedTable(["Parameter", "With", "#Correlation"], rows)


def cure_table(calibration: Calibration) -> PrintedTable:
    """Next steps, best first, with the expected tip error after each."""
    said = {True: "yes", False: "no"}
    rows = [[each.words, in_mm(each.expected_rms_mm), said[each.recommended]] for each in calibration.cures]
    rows += [["As it is", in_mm(calibration.tip_std[1]), "–"]] if rows else []
    return PrintedTable(["Next step", "#Tip error, RMS", "Recommended"], rows)


def direction_table(calibration: Calibration) -> tuple[PrintedTable, list[str]]:
    """Null and weak directions with what lowers each, the costly ones first; and those that move no tip, by name."""
    costly, harmless = [], []
    pairs = zip(calibration.identifiability.directions, calibration.advice, strict=True)
    for each, advice in sorted(pairs, key=lambda pair: -pair[0].tip_mm):
        kind = each.kind if isinstance(each, NullDirection) else "weak"
        if advice == NOT_NEEDED:
            harmless.append(f"{each.words} ({kind})")
        else:
            tip = f"{each.tip_mm:.2g}" if math.isfinite(each.tip_mm) else "–"
            costly.append([each.words, kind, tip, capital(advice)])
    return PrintedTable(["What changes unseen", "Kind", "#At the tip, mm", "Cure"], costly), sorted(harmless)


def effect_table(calibration: Calibration) -> PrintedTable:
    """A line for each effect beside the geometry, the likeliest first, and for errors of the dial that rows show."""
    shown = [error for error in calibration.dial_errors if error.shown]
    rows = [[capital(error.words), "yes", "–", error.shown_size, "–", "no"] for error in shown]
    for each in calibration.effect_sizes:
        sizes = (sized(size, each.unit) for size in (each.size, each.expected_size))
        told, corrected = ("yes" if yes else "no" for yes in (each.shown, each.key in calibration.corrected))
        rows.append([capital(each.words), told, f"{each.gain:.1f}", *sizes, corrected])
    titles = ("Effect", "Shown by the samples", "#Gain", "#Most likely size", "#Usual size", "Corrected")
    return PrintedTable(titles, rows)


def constant_table(calibration: Calibration) -> PrintedTable:
    """A line for each constant that the instruments take for exact, by what of the expected tip error it causes."""
    rows = []
    for each in calibration.leverages:
        tips = (f"{tip:.2g}" for tip in (each.tip_mm, each.left_mm))
        rows.append([capital(each.words), sized(each.std, each.unit), *tips, capital(each.cure)])
    titles = ("#Standard deviation", "#That moves the tip by, mm", "#Left in the tip error, mm", "Told by")
    return PrintedTable(("Taken for exact", *titles), rows)
