"""`casacal plan`: plan which touches to make."""

from __future__ import annotations

import argparse
import math
import shlex
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from casacal.cli import cell, common
from casacal.cli.common import DONE, JSON, PROBLEM, add, whole_number
from casacal.cli.terminal import answer
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from casacal.model.problem_file import ProblemFile
    from casacal.planning.clearance import Clearance
    from casacal.planning.plan import Plan
    from casacal.planning.set_ups import SetUp

HELP = "plan which touches to make"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal plan`."""
    parser.description = (
        "Choose the touches that leave the smallest tip error, among many that the drawn arm can make in the "
        "problem's cell, and write them in the order of a short path. Some repeat others, some are kept to verify."
    )
    add(parser, *PROBLEM)
    add(parser, "--instrument NAME", "for which one, where a problem has several instruments")
    add(parser, "--out FILE", "plan to write, such as plan.csv", required=True)
    words = "number of touches in all; default: until more would only average noise, and more than calibrate needs"
    add(parser, "--touches N", words, kind=whole_number)
    add(parser, "--tolerance MM", "instead of --touches: as many as this expected tip error takes", kind=float)
    cell.add_where(parser)
    words = "tip: least mean tip error (default); parameters: least volume of their uncertainty (D-optimal)"
    add(parser, "--criterion NAME", words, default="tip")
    add(parser, "--after FILE", "samples that were taken already; the plan adds to them")
    words = "with --after: what may have moved since, in rad or mm, such as theta4=0.01 after a new motor"
    add(parser, "--loose NAME=STD ...", words)
    add(parser, "--pool N", "number of candidates; default: 3000", kind=whole_number, default=3000)
    words = "part kept to verify, or a few more where these place every face; default: 0.15"
    add(parser, "--check F", words, kind=float, default=0.15)
    add(parser, "--again F", "part repeated at the end; default: 0.05", kind=float, default=0.05)
    cell.add_clearance(parser)
    add(parser, *cell.TILT, kind=float)
    words = "also touch a gauge block of this height on the first face; writes a problem with it beside the plan"
    add(parser, "--block MM", words, kind=float)
    add(parser, "--setups", "also compare other set-ups of the cell")
    add(parser, "--sheet FILE", "write a sheet to print and fill in, such as sheet.html")
    add(parser, "--program LANGUAGE ...", "also write a robot program: rapid, krl or urscript; may be repeated")
    add(parser, "--retreat MM", "standoff of programs from the face; default: 20", kind=float, default=20.0)
    add(parser, "--seed K", "seed of random numbers; default: 0", kind=whole_number, default=0)
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Plan as the options say; returns 0."""
    from casacal.model.problem_file import load_problem
    from casacal.planning.plan import cell_words, document, plan_sentences
    from casacal.planning.route import CHECK, FIT, touches_needed
    from casacal.planning.set_ups import POOL, SetUp, set_ups

    if options.touches is not None and options.tolerance is not None:
        raise CasacalError("Got --touches and --tolerance", "Give one of them")
    if not 0 < options.retreat < 1000:
        raise CasacalError(f"--retreat is {options.retreat:g}", "Give a number of mm from 1 to 999")
    source = common.of_instrument(load_problem(options.problem), options.instrument)
    outs = [options.out, *([] if options.sheet is None else [options.sheet])]
    common.spare(outs, *(file.path for file in source.files), source.samples, options.targets, options.after)
    warned = _wrong_with(source, options)
    source, clearance = cell.in_cell(source, options, tilt=options.tilt), cell.clearance_of(options)
    texts, place = dict[Path, str](), Path(options.problem)
    if options.block is not None:
        source, place, texts = _with_block(source, options)
    found = _planned(source, options, clearance)
    compared, fitted, later = tuple[SetUp, ...](), found.purposes.count(FIT), options.after is not None
    if options.setups or (source.problem.instrument.probe is not None and not later and fitted <= POOL):
        box, targets = cell.where(options, source)
        compared = set_ups(
            source.problem,
            source.cell,
            touches=fitted,
            box=box,
            targets=targets,
            clearance=clearance,
            seed=options.seed,
        )
    written, hindered = _written(source, options, found, clearance, texts)
    warned += hindered
    rows = len(found) - found.purposes.count(CHECK)
    if rows < (least := touches_needed(source.problem, found.samples)) and not later:
        what = f"{rows} touches are fitted, but casacal calibrate needs at least {least} for all unknowns. Ask for more"
        warned = [f"{what}, keep fewer to verify, or hold parameters", *warned]
    there = "inside the box" if options.box else "over the workspace" if options.targets is None else "at the targets"
    answer(
        options,
        {**document(found, source.problem, compared, written, clearance), "warnings": warned},
        *cell_words(found, source.problem, clearance),
        *plan_sentences(found, compared, where=there, pool=options.pool, after=later, every=options.setups),
        *(f"warning: {each}" for each in warned),
        *(f"Written: {place}" for place in written),
        *_following(options, compared, place, of_one=bool(texts)),
    )
    return DONE


def _following(options: argparse.Namespace, compared: Sequence[SetUp], place: Path, *, of_one: bool) -> list[str]:
    """What to type next: the plan of the set-up that is worth most, and `casacal measure`."""
    from casacal.planning.set_ups import worth_most

    best = worth_most(compared) if compared else None
    named = [] if options.instrument is None or of_one else [f"--instrument={options.instrument}"]
    numbers = {"--table": options.table, "--link-radius": options.link_radius}
    named += [f"{name}={value:g}" for name, value in numbers.items() if value is not None]
    named += [f"--keep-out={box}" for box in options.keep_out]
    command = shlex.join(["casacal", "measure", place.as_posix(), *named, "--plan", options.out, "--out"])
    made = []
    if best is not None and best[0].option.startswith("--plate"):
        made = [f"To do so: casacal new with {best[0].option}"]
    elif best is not None:
        made = [f"To do so: {options.typed} {best[0].option}"]
    return [*made, f"Next: {command} SAMPLES"]


def _with_block(source: ProblemFile, options: argparse.Namespace) -> tuple[ProblemFile, Path, dict[Path, str]]:
    """The problem with a gauge block, the folder in which it is to stand beside the plan, and its text by file."""
    from casacal.model.problem_file import CONVENTIONS
    from casacal.model.problem_text import Answers
    from casacal.planning.set_ups import block_text, with_block
    from casacal.simulation.cell import Cell

    Answers(block=options.block)
    faces = source.cell.faces if isinstance(source.cell, Cell) else ()
    if there := [face.label for face in faces if face.label.startswith("block")]:
        what = f"Got --block, and '{there[0]}' is a gauge block of this problem already"
        raise CasacalError(what, "Leave --block out, or plan for the problem without it")
    blocked = with_block(source.problem, source.cell, options.block) if isinstance(source.cell, Cell) else None
    if blocked is None:
        raise CasacalError("Got --block, and no gauge block stands among what is measured here", "Leave it out")
    name = f"{source.name}_block"
    folder = Path(options.out).parent / name
    texts = {folder / "problem.py": block_text(source, blocked[1], folder, options.instrument)}
    if source.confirmed:  # it is the same arm, about which nobody is asked twice
        texts[folder / CONVENTIONS] = (Path(source.path).parent / CONVENTIONS).read_text(encoding="utf-8")
    return replace(source, name=name, problem=blocked[0], cell=blocked[1]), folder, texts


def _wrong_with(source: ProblemFile, options: argparse.Namespace) -> list[str]:
    """A warning of single rows of --after that look wrong; raises CasacalError where more than single rows do."""
    if (after := options.after) is None:
        return []
    from casacal.calibration.check import check

    found = check(source.problem, source.problem.read(after))
    if not (wrong := [finding for finding in found if finding.severity == "error"]):
        return []
    what = f"{after} looks wrong ({', '.join(finding.about for finding in wrong)})"
    fix = f"Run casacal check {shlex.join([options.problem, after])} and mend the samples first"
    if not all(finding.lines for finding in wrong):
        raise CasacalError(f"{what}, so nothing can be planned on what it says of the arm", fix)
    return [f"{what}. {fix}"]


def _planned(source: ProblemFile, options: argparse.Namespace, clearance: Clearance) -> Plan:
    from casacal.planning.plan import plan, touches_for

    box, targets = cell.where(options, source)
    after = None if options.after is None else source.problem.read(options.after)
    touches, tolerance = options.touches, options.tolerance
    loose = common.stds_of("--loose", options.loose, "theta4=0.01")
    for name, std in loose.items():
        if not 0 < std < math.inf:
            raise CasacalError(f"--loose {name}={std:g} is no standard deviation", "Give a positive number")
    if loose and after is None:
        raise CasacalError("Got --loose without --after", "Name the samples from which the arm was calibrated")
    if touches is None:
        touches = touches_for(
            source.problem,
            source.cell,
            tolerance,
            box=box,
            targets=targets,
            clearance=clearance,
            after=after,
            loose=loose,
            again=options.again,
            check=options.check,
        )
        touches = min(max(touches, 3), options.pool)
    return plan(
        source.problem,
        source.cell,
        touches=touches,
        pool=options.pool,
        again=options.again,
        check=options.check,
        box=box,
        targets=targets,
        criterion=options.criterion,
        clearance=clearance,
        after=after,
        loose=loose,
        seed=options.seed,
    )


def _written(
    source: ProblemFile, options: argparse.Namespace, found: Plan, clearance: Clearance, texts: dict[Path, str]
) -> tuple[list[str], list[str]]:
    """Write the plan, what was asked for beside it, and further texts, all or none: their paths, and warnings."""
    from casacal.files import together, write_text
    from casacal.planning.handouts import PROGRAMS, approaches, program_text, sheet_page
    from casacal.planning.plan import cell_words, plan_text

    problem, name, warned = source.problem, source.name, list[str]()
    others, texts = len(texts), {Path(options.out): plan_text(found, problem, name, clearance), **texts}
    if options.sheet is not None:
        texts[Path(options.sheet)] = sheet_page(
            problem, found, name, cell_words(found, problem, clearance), found.cell, clearance
        )
    if options.program:
        ways = approaches(problem, found, source.cell, retreat=options.retreat, clearance=clearance)
        for language in dict.fromkeys(options.program):
            text = program_text(problem, found, ways, language, name)
            texts[Path(options.out).with_suffix(PROGRAMS[language].ending)] = text
        held = [str(k + 1) for k, retreat in enumerate(ways.retreat.tolist()) if math.isnan(retreat)]
        blocked = [str(k) for k, clear in enumerate(ways.clear.tolist(), 1) if not clear and str(k) not in held]
        if held:
            warned.append(
                f"from touch {', '.join(held)} the arm cannot draw back by {options.retreat:g} mm inside its joint "
                "limits; the program leaves it out. A smaller --retreat may do"
            )
        if blocked:
            warned.append(
                f"no clear path was found to {'touch' if len(blocked) == 1 else 'touches'} {', '.join(blocked)}; the "
                f"program stops before {'it' if len(blocked) == 1 else 'each'}"
            )
    if len(texts) < 1 + others + (options.sheet is not None) + len(set(options.program)):
        raise CasacalError("Two of the files to write have the same name", "Name others")
    if any(path.exists() and not path.is_file() for path in texts):  # a pipe takes no place beside others
        for path, text in texts.items():
            write_text(path, text)
        return [path.as_posix() for path in texts], warned
    with ExitStack() as sets:  # the folder of the plan is entered first, so that its files are placed last
        for folder in dict.fromkeys(path.parent.resolve() for path in texts):
            some = [path for path in texts if path.parent.resolve() == folder]
            place = sets.enter_context(together(folder, [path.name for path in reversed(some)], named=some[0]))
            for path in some:
                write_text(place / path.name, texts[path])
    return [path.as_posix() for path in texts], warned
