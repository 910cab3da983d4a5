"""A calibration in words: the brief for the terminal, tables (the report's as well), and the full summary."""

from __future__ import annotations

import math
import re
import shlex
import textwrap
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from casacal.calibration.calibration import NOT_NEEDED, Calibration, parts_of
from casacal.calibration.motion import tip_error
from casacal.calibration.result_json import image_words, parameter_rows, verdict_lines
from casacal.calibration.verdict import (
    VERIFY,
    WithVerdict,
    doubts,
    earlier_contradicted,
    held_as_drawn,
    priors_contradicted,
    unexplained,
    wrong_with_samples,
)
from casacal.data.samples import Measurements
from casacal.deployment.result import Verdict
from casacal.errors import CasacalError
from casacal.fit.methods import minimises
from casacal.pages.drawing import fixed, shortened, shown_unit
from casacal.pages.drawing import mm as in_mm
from casacal.planning.cures import Cure
from casacal.public import __version__
from casacal.uncertainty.identifiability import NullDirection, WeakDirection, correlated_pairs
from casacal.wording import METRE, capital, chance, counted, figures, listed, lower, mm, sized

WORSE = 1.5  # expected error of the flange over that of the tip from which it is the tip that is worth correcting
MOST_LINES = 15  # lines of the whole, files written included
LONGEST = 60  # characters of a face's name
SHOWN_DIRECTIONS = 6
SHOWN_PAIRS = 4
PLANNED = (
    "casacal plan PROBLEM --after SAMPLES plans such touches; a new face or step goes into the problem file first. "
    "Figures here use noise and effects as found, those of plan as stated."
)


def next_step(
    calibration: Calibration, verdict: Verdict, *, about: str = "PROBLEM SAMPLES", out: str | None = None
) -> str:
    """One sentence; about: problem and samples, as a command line names them; out: folder of the files, if any."""
    check = f"casacal check {about}"
    tool = calibration.hidden_tool if verdict.level != "do not use" else None
    if tool is not None:
        return f"measure {listed(tool.names)}, state it in the problem file with its prior_std, and calibrate again."
    if verdict.level == "do not use":
        return _repair(calibration.unjudged, check)
    if verdict.level == "use with care":
        kept = "" if out is not None else "; --out DIR keeps the result and its report"
        step = next((doubt.step for doubt in doubts(calibration)[:1]), "")
        checked = calibration.unjudged.suspicious  # the data check, which named nothing, or the result would be denied
        return f"{step or (VERIFY if checked else f'run {check}, which looks closer at the samples')}{kept}."
    if out is None:
        return "add --out DIR to keep the result and its report; casacal compensate, predict and export read it."
    tip = (
        ""
        if calibration.flange_std[1] <= WORSE * calibration.tip_std[1]
        else " (--frame tip if this tip does the work)"
    )
    where = f"{shlex.quote(f'{out}/result.json')} TARGETS --out FILE{tip}"
    return f"verify with fresh touches, then correct joint targets with casacal compensate {where}."


def best_cure(calibration: Calibration) -> str:
    """The best cure and its figure, as a sentence; empty where none gains much. Not for who must not use the result."""
    cure = _best(calibration)
    if cure is None:
        return ""
    return f"{cure.words}; expected tip error {fall(calibration.tip_std[1], cure.expected_rms_mm)}."


def nothing_helps(calibration: Calibration) -> str:
    """A sentence for the case that no cure gains much; empty where one does or none was tried."""
    if not calibration.cures or _best(calibration) is not None:
        return ""
    least = calibration.cures[0].expected_rms_mm
    return f"More touches help little: expected tip error {fall(calibration.tip_std[1], least)} at best."


def fall(now: float, after: float) -> str:
    """Two tip errors, with as many digits as show the difference."""
    digits = 2 if now >= 0.1 and after >= 0.02 and round(now, 2) > round(after, 2) else 3
    return f"{now:.{digits}f} -> {after:.{digits}f} mm"


def _best(calibration: Calibration) -> Cure | None:
    """The first of the cures that are worth it and bound the tip error."""
    worth = (cure for cure in calibration.cures if cure.recommended and math.isfinite(cure.expected_rms_mm))
    return next(worth, None)


def _repair(calibration: Calibration, check: str) -> str:
    reference, wrong = calibration.reference, wrong_with_samples(calibration)
    if held_as_drawn(calibration):
        return "free it, or state in the problem where it is, and calibrate again."
    if calibration.earlier is not None and earlier_contradicted(calibration):
        rows = f"casacal changed {calibration.earlier.file} {calibration.samples.file}"
        return f"run {rows}, which says what has changed; then name that with --loosen."
    if wrong:
        for name in re.findall(r"--set (\S+?)=", wrong[0].fix):  # what is to be set otherwise is not set so again
            check = re.sub(rf" --set {re.escape(name)}=\S+", "", check)
        return f"{lower(wrong[0].fix)}; then run {check}."
    if not calibration.result.converged:
        return f"run {check}, which looks closer at the samples; or try another way to the minimum, --method lm."
    if reference is not None and not reference.agrees:
        if minimises(calibration.method):
            return f"run {check}; then compare the costs of --method lm and --method ipopt, and keep the lower one."
        return "use --method lm or sckf-lm, which go to the minimum."
    if priors_contradicted(calibration) and not unexplained(calibration):
        return "state priors that fit the arm (--accuracy MM, --prior NAME=STD), and calibrate again."
    if math.isfinite(calibration.tip_std[1]):
        return f"run {check}, which looks closer at the samples."
    cure = _best(calibration)
    return f"{cure.words}." if cure is not None else "give every parameter a prior, or hold it with --fix."


def brief(
    calibration: Calibration,
    verdict: Verdict,
    *,
    about: str = "PROBLEM SAMPLES",
    out: str | None = None,
    expected: Sequence[str] = (),
    width: int = 100,
    room: int = MOST_LINES,
) -> str:
    """At most `room` lines of at most `width` characters, unless a single word is longer.

    about, out: as for `next_step`. expected: further sentences on accuracy, left out when the verdict denies it.
    """
    calibration = calibration.unjudged
    denied = verdict.level == "do not use"
    head = [_subject(calibration), *verdict_lines(calibration, verdict)]
    tail = [] if denied else [*expected, _residual(calibration)]
    stated = verdict.words.lower()
    others = [reason for reason in verdict.reasons if reason.lower() not in stated]
    others += image_words(calibration, verdict)
    above = _wrapped(head, width)
    cure = "" if denied else best_cure(calibration)
    first = verdict.level == "calibrated" and cure  # a doubt is settled first
    for named in (about, "PROBLEM SAMPLES"):  # long paths give way to what speaks against the result
        step = next_step(calibration, verdict, about=named, out=out)
        below = _wrapped([*tail, f"Next: {cure if first else step}"], width)
        left = room - len(above) - len(below)
        if left >= min(len(others), 2):
            break
    reasons = _reasons(others, width, left)
    said = f"Then: {step if first else cure}" if cure else "" if denied else nothing_helps(calibration)
    more = _wrapped([said], width)
    if len(reasons) + len(more) > left:  # advice gives way to what speaks against the result
        more = []
    return "\n".join([*above, *reasons, *below, *more]) + "\n"


def _subject(calibration: Calibration) -> str:
    held = calibration.heldout
    rows = f"{len(calibration.samples)} samples"
    if held is not None:
        rows += f", {len(held.measured)} of them held out{together(calibration)}"
    checked = ""
    if calibration.reference is not None:
        found = calibration.reference
        lower = not minimises(calibration.method) and found.gap > 0
        apart = f"finds a cost lower by {found.gap:.2g}" if lower else "DIFFERS"
        checked = f"; {found.solver} {'agrees' if found.agrees else apart}"
    known = "" if calibration.earlier is None else f" and {calibration.earlier.file}"
    return f"{calibration.fit.problem.robot.name}: {calibration.method} from {rows}{known}{checked}"


def together(calibration: Calibration) -> str:
    """How rows were held out, where not one by one."""
    return "" if calibration.heldout_by == "rows" else f" by {calibration.heldout_by}"


def _residual(calibration: Calibration) -> str:
    part = "fit" if calibration.heldout is None else "heldout"
    before, after = (calibration.metrics[when][part] for when in ("before", "after"))
    assert before is not None
    assert after is not None
    said = calibration.fit.problem.words
    held = "" if part == "fit" else "held-out "
    known = "as drawn" if calibration.earlier is None else "by the earlier result"
    return (
        f"Residual on the {held}{said.things}, not accuracy: {figures(after['rmse_mm'])} {said.unit} RMS ({known}: "
        f"{figures(before['rmse_mm'])})."
    )


def _reasons(reasons: Sequence[str], width: int, room: int) -> list[str]:
    """As many reasons as fit, a bullet each; the first is cut short rather than left out, the rest are counted."""
    lines: list[str] = []
    for k, reason in enumerate(reasons):
        bullet = textwrap.wrap(reason, width, initial_indent="- ", subsequent_indent="  ", break_on_hyphens=False)
        left = room - len(lines) - (k + 1 < len(reasons))  # a line to count the rest, unless this is the last
        left = max(left, 1) if k == 0 else left
        if len(bullet) <= left:
            lines += bullet
        elif k == 0:
            lines += [*bullet[: left - 1], f"{bullet[left - 1][: width - 4]} ..."]
        else:
            return [*lines, f"- {len(reasons) - k} more with --verbose"][: max(room, 1)]
    return lines


def _wrapped(sentences: Sequence[str], width: int) -> list[str]:
    return [
        line
        for sentence in sentences
        for line in textwrap.wrap(
            sentence, width, subsequent_indent="  ", break_on_hyphens=False, break_long_words=False
        )
    ]


@dataclass(frozen=True)
class PrintedTable:
    """Rows of text under titles; a title that begins with # heads a column of numbers."""

    columns: Sequence[str]
    rows: Sequence[Sequence[str]]

    def text(self) -> str:
        """Lines in columns as wide as they must be, in characters that every terminal has."""
        titles = [title.removeprefix("#") for title in self.columns]
        wide = [max(map(len, column)) for column in zip(titles, *self.rows, strict=True)]
        numbers = [title.startswith("#") for title in self.columns]
        return "\n".join(
            "  ".join(
                f"{cell:>{width}}" if number else f"{cell:<{width}}"
                for cell, width, number in zip(row, wide, numbers, strict=True)
            ).rstrip()
            for row in (titles, *self.rows)
        ).replace("–", "-")


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
    faces = calibration.left_out
    has_predictions = any(math.isfinite(face.predicted_mm) for face in faces)
    predicted = ["#Predicted, mm RMS", "#Found over predicted"] if has_predictions else []
    rows = [
        [
            shortened(face.face, LONGEST),
            f"{face.rows:,}",
            fixed(face.actual_mm),
            *([fixed(face.predicted_mm), fixed(face.ratio, 2)] if has_predictions else []),
            f"{face.p:.2g}",
        ]
        for face in faces
    ]
    group = capital(calibration.fit.problem.words.group)
    return PrintedTable([group, "#Rows", "#Found, mm RMS", *predicted, "#p"], rows)


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
    cures = [
        [cure.words, in_mm(cure.expected_rms_mm), "yes" if cure.recommended else "no"] for cure in calibration.cures
    ]
    rows = [*cures, ["As it is", in_mm(calibration.tip_std[1]), "–"]] if cures else []
    return PrintedTable(["Next step", "#Tip error, RMS", "Recommended"], rows)


def direction_table(calibration: Calibration) -> tuple[PrintedTable, list[str]]:
    """Null and weak directions with what lowers each, the costly ones first; and those that move no tip, by name."""
    found = calibration.identifiability
    every: tuple[NullDirection | WeakDirection, ...] = (*found.null, *found.weak)
    costly, harmless = [], []
    for each, advice in sorted(zip(every, calibration.advice, strict=True), key=lambda pair: -pair[0].tip_mm):
        kind = each.kind if isinstance(each, NullDirection) else "weak"
        if advice == NOT_NEEDED:
            harmless.append(f"{each.words} ({kind})")
        else:
            costly.append(
                [each.words, kind, f"{each.tip_mm:.2g}" if math.isfinite(each.tip_mm) else "–", capital(advice)]
            )
    return PrintedTable(["What changes unseen", "Kind", "#At the tip, mm", "Cure"], costly), sorted(harmless)


def effect_table(calibration: Calibration) -> PrintedTable:
    """A line for each effect beside the geometry, the likeliest first, and for errors of the dial that rows show."""
    corrected = set(calibration.corrected)
    rows = [
        [
            capital(each.words),
            "yes" if each.shown else "no",
            f"{each.gain:.1f}",
            sized(each.size, each.unit),
            sized(each.expected_size, each.unit),
            "yes" if each.key in corrected else "no",
        ]
        for each in calibration.effect_sizes
    ]
    dial = [error for error in calibration.dial_errors if error.shown]
    rows = [[capital(error.words), "yes", "–", error.shown_size, "–", "no"] for error in dial] + rows
    titles = ("Effect", "Shown by the samples", "#Gain", "#Most likely size", "#Usual size", "Corrected")
    return PrintedTable(titles, rows)


def constant_table(calibration: Calibration) -> PrintedTable:
    """A line for each constant that the instruments take for exact, by what of the expected tip error it causes."""
    rows = [
        [
            capital(each.words),
            sized(each.std, each.unit),
            f"{each.tip_mm:.2g}",
            f"{each.left_mm:.2g}",
            capital(each.cure),
        ]
        for each in calibration.leverages
    ]
    titles = (
        "Taken for exact",
        "#Standard deviation",
        "#That moves the tip by, mm",
        "#Left in the tip error, mm",
        "Told by",
    )
    return PrintedTable(titles, rows)


def corrected_words(calibration: Calibration) -> list[str]:
    """Corrected effects and the tip error of a controller that cannot correct them; empty where none is corrected."""
    named = listed([each.words for each in calibration.tried if each.corrected])
    if not named:
        return []
    alone = tip_error(calibration.fit, calibration.result, ())
    return [
        f"The result corrects {named}; predict, compensate and the C export apply it. Tables of lengths",
        f"and angles cannot: with those alone expect a tip error of {mm(alone)} RMS.",
    ]


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
