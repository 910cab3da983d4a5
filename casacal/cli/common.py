"""Shared by commands: arguments for problems, samples and results, options that change a problem, exit codes."""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.data.samples import Measurements, Samples
    from casacal.data.text import Table
    from casacal.deployment.arm import CalibratedArm
    from casacal.model.problem import Problem
    from casacal.model.problem_file import ProblemFile

DONE, FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130
PROBLEM = "PROBLEM", "a folder with a problem.py, or such a file"
RESULT = "RESULT", "result.json of casacal calibrate, or the .truth.json of casacal simulate"
OF_SEVERAL = "where a problem has several instruments"
INSTRUMENT = "--instrument NAME", f"instrument whose tip is meant; default: the first, {OF_SEVERAL}"
FORCE = "--force", "accept a result that must not be used; the file says so"
JSON = "--json", "print the answer as JSON, and nothing else"  # arguments of several commands, as `add` takes them


def add(
    parser: argparse._ActionsContainer,
    spelled: str,
    words: str,
    *,
    kind: Callable[[str], Any] = str,
    default: Any = None,
    choices: Sequence[str] | None = None,
    required: bool = False,
    dest: str | None = None,
) -> None:
    """Add an argument, spelled as in a usage line.

    "PROBLEM" and "[SAMPLES]" have a place; "--json" is said or not; "--seed K" takes a value, "--merge DIR+" one or
    more, and "--prior NAME=STD ..." may come several times, which makes a list.
    """
    name, _, value = spelled.partition(" ")
    if not name.startswith("-"):
        place = name.strip("[]")
        nargs = "?" if name.startswith("[") else None
        parser.add_argument(place.lower(), metavar=None if choices else place, nargs=nargs, choices=choices, help=words)
    elif not value and choices is None:
        parser.add_argument(name, action="store_true", help=words)
    else:
        often = value.endswith(" ...")
        parser.add_argument(
            name,
            metavar=value.removesuffix(" ...").removesuffix("+") or None,
            action="append" if often else "store",
            nargs="+" if value.endswith("+") else None,
            type=kind,
            default=[] if often else default,
            choices=choices,
            required=required,
            dest=dest,
            help=words,
        )


def add_frame(parser: argparse.ArgumentParser, words: str) -> None:
    """Add --frame: flange or tip."""
    add(parser, "--frame", f"{words}; default: flange", default="flange", choices=("flange", "tip"))


def of_instrument(source: ProblemFile, name: str | None) -> ProblemFile:
    """The arm with one of its instruments; CasacalError where there are several and none is named."""
    problem = source.problem
    if name is None and len(problem.instruments) > 1:
        fix = f"Name it: --instrument {problem.names[0]}"
        raise CasacalError(f"This is for one instrument, and there are {', '.join(problem.names)}", fix)
    return source if name is None else replace(source, problem=problem.measured_by(name))


def columns_of_today(source: ProblemFile, session: str | None) -> list[str]:
    """Label columns that no plan knows, such as the session's; CasacalError where --session is given and none is."""
    found = [each for each in source.problem.layout().labels if each != source.problem.instrument.groups]
    if session is not None and not found:
        what = f"Got --session {session}, and {source.name} has no column that tells sessions apart"
        raise CasacalError(what, "Leave it out, or give an unknown per='session' in the problem")
    return found


def add_readings(parser: argparse.ArgumentParser, words: str = "the readings, when SAMPLES has none") -> None:
    """Add the options that name what a table or a program without readings lacks."""
    add(parser, "--readings FILE", f"CSV or .xlsx with {words}, as a robot program")
    add(parser, "--id COLUMN", "column that joins readings to their poses; default: pose", default="pose")


def spare(outs: Iterable[str | Path], *inputs: str | Path | None, option: str = "--out", own: bool = False) -> None:
    """Raise CasacalError where a command would write over its inputs or, unless `own`, over files of others."""
    from casacal.files import recover, refuse_others

    read = [Path(file) for file in inputs if file is not None and Path(file).is_file()]
    for out in outs:
        path = Path(out)
        if path.suffix.lower() in (".xlsx", ".npy", ".npz"):
            raise CasacalError(f"'{out}' would not be a {path.suffix} file", "Name one that ends in .csv")
        recover(path.parent)
        if path.exists() and any(path.samefile(file) for file in read):
            raise CasacalError(f"'{out}' is to be written, and it is what the command reads", f"Name another {option}")
        if not own:
            refuse_others(out, option=option)


def read_arm(options: argparse.Namespace, *inputs: str | None) -> CalibratedArm:
    """RESULT as --instrument sees it; CasacalError where --out would overwrite it, these, or what it is made from."""
    from casacal.deployment.arm import for_instrument
    from casacal.deployment.result_file import read_result

    spare([options.out], options.result, *inputs)
    result = for_instrument(read_result(options.result), options.instrument)
    spare([options.out], result.file, *made_from(result))
    return result


def made_from(result: CalibratedArm) -> list[Path]:
    """The files that a result's arm and samples came from, where they may still stand."""
    data = result.found.data
    named = [*(file.path for file in result.source.files), data.file, *data.instruments.values()]
    return [Path(result.file).parent / name for name in named if name]


def whole_number(text: str) -> int:
    """A seed, as argparse reads it: zero or a positive whole number."""
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is no whole number from zero on")
    return int(text)


def box_of(text: str, *, option: str = "--box") -> tuple[tuple[float, float], tuple[float, float], tuple[float, float]]:
    """Ranges of x, y, z, mm, as --box says them; raises CasacalError."""
    try:
        (x0, x1), (y0, y1), (z0, z1) = (map(float, part.split(":")) for part in text.split(","))
    except ValueError:
        raise CasacalError(f"{option} {text} is not X0:X1,Y0:Y1,Z0:Z1", "Give three ranges in mm") from None
    if not all(map(math.isfinite, (x0, x1, y0, y1, z0, z1))):
        raise CasacalError(f"{option} is {text}", "Give numbers of mm: 100000 is far enough")
    if not (x0 < x1 and y0 < y1 and z0 < z1):
        raise CasacalError(f"{option} {text} is empty", "Give each range as LOW:HIGH in mm")
    return (x0, x1), (y0, y1), (z0, z1)


def add_samples(parser: argparse.ArgumentParser) -> None:
    """Add SAMPLES, --samples, and readings in a file of their own."""
    add(
        parser,
        "[SAMPLES]",
        "CSV (-: standard input), .xlsx, .npy or .npz; default: samples.csv beside the problem; or a robot program",
    )
    words = "samples of each of several instruments, such as --samples dial=a.csv --samples tracker=b.csv; default: "
    words += "samples-dial.csv and so on beside the problem"
    add(parser, "--samples NAME=FILE ...", words, dest="sets")
    add_readings(parser)


def sample_files(source: ProblemFile, options: argparse.Namespace) -> dict[str, str]:
    """The samples file of each instrument by name, as named, else next to the problem; CasacalError without one."""
    names = source.problem.names
    if len(names) == 1:
        if options.sets:
            raise CasacalError("--samples NAME=FILE is for several instruments", "Name the file alone, as SAMPLES")
        if options.samples is not None and not options.samples.strip():
            raise CasacalError("SAMPLES is empty", "Name a file, or leave it out for samples.csv beside the problem")
        usual = source.samples.as_posix() if source.samples is not None and source.samples.is_file() else None
        if (file := options.samples or usual) is None:
            raise CasacalError(f"{source.path} has no samples.csv beside it", "Name a samples file")
        return {names[0]: file}
    if options.samples is not None:
        wanted = " ".join(f"--samples {name}=FILE" for name in names)
        raise CasacalError(f"Got one file for {len(names)} instruments", f"Name one for each: {wanted}")
    if options.readings is not None:
        raise CasacalError("--readings is for one instrument", "Join readings and poses in one file for each")
    files = dict[str, str]()
    for each in options.sets:
        name, equals, file = each.partition("=")
        if not equals or not file.strip():
            raise CasacalError(f"--samples {each} is not NAME=FILE", f"Give one such as {names[0]}=samples.csv")
        if source.problem.number(name.strip()) >= 0 and name.strip() in files:
            raise CasacalError(f"--samples gives '{name.strip()}' twice", "Give it once")
        files[name.strip()] = file
    for i, name in enumerate(names):
        default = source.samples_of(i)
        if name not in files and not options.sets and default is not None and default.is_file():
            files[name] = default.as_posix()
        elif name not in files:
            raise CasacalError(f"There are no samples of the {name}", f"Name them: --samples {name}=FILE")
    return {name: files[name] for name in names}


def read_samples(source: ProblemFile, options: argparse.Namespace, *, absurd: bool = False) -> Samples | Measurements:
    """The samples of the only instrument, or of all; raises CasacalError as `sample_files` and `Problem.read` do."""
    from casacal.data.samples import Measurements, Samples
    from casacal.programs.endings import is_program

    problem, files = source.problem, sample_files(source, options)
    if len(files) == 1:
        (only,) = files.values()
        if is_program(only):
            return Samples.from_table(program_table(only, options), problem.layout(), absurd=absurd)
        return problem.read(only, readings=options.readings, key=options.id, absurd=absurd)
    sets = (problem.read(file, i, absurd=absurd) for i, file in enumerate(files.values()))
    return Measurements(problem.names, tuple(sets))


def program_table(path: str, options: argparse.Namespace, holds: str = "readings") -> Table:
    """Joint targets of a robot program, joined by their names to what `--readings` has of them."""
    from casacal.data.samples import read_any_table
    from casacal.data.text import joined_tables
    from casacal.programs.read import joint_table, read_program

    if options.readings is None:
        what = f"'{path}' is a robot program, which holds joint targets and no {holds}"
        raise CasacalError(what, f"Name a CSV by --readings, with a column '{options.id}' of the targets' names")
    readings = read_any_table(options.readings)
    named = set(readings.column(options.id)) if options.id in readings.header else ()
    program = read_program(path)
    table = joint_table(program, named, options.id)
    if program.puzzles and set(named) - set(table.column(options.id)):  # the reading's target may be what is not known
        program.refuse_puzzles()
    return joined_tables(table, readings, key=options.id)


Read = TypeVar("Read")


def add_adjustments(parser: argparse.ArgumentParser) -> None:
    """Add the options that change a problem without an editor."""
    add(parser, "--fix NAMES ...", "parameters to hold at nominal: alpha,a3,...")
    add(parser, "--free NAMES ...", "parameters to estimate that are held: tool,...")
    words = "another number of the instrument, such as sign=-1, travel=-5:5 or noise_std=0.02"
    add(parser, "--set NAME=NUMBER ...", words)
    add(parser, "--prior NAME=STD ...", "prior standard deviation in mm or rad, or inf")
    add(parser, "--accuracy MM", "scale the arm's priors to the accuracy that its maker states", kind=float)


def adjusted(problem: Problem, options: argparse.Namespace) -> Problem:
    """The problem as the options want it; raises CasacalError for what cannot be read or does not exist."""
    if options.set:
        example = "sign=-1, noise_std=0.02 or travel=-5:5"
        problem = problem.with_settings(settings_of("--set", options.set, "NAME=NUMBER", example, number_or_range))
    free, fix = names_of("--free", options.free), names_of("--fix", options.fix)
    priors = stds_of("--prior", options.prior, "a3=0.5")
    problem = problem.free(*free)
    if options.accuracy is not None:  # of the arm as it is then calibrated; a prior of its own is meant as it stands
        from casacal.uncertainty.priors import scaled_to_accuracy

        problem = scaled_to_accuracy(problem, options.accuracy, held=fix)
    problem = problem.with_prior(priors).fix(*fix)
    left = problem.free_names() if fix else [*free, *priors]
    for change, names in (("freed (--free)", free), ("given a prior (--prior)", priors)):
        for name in names:
            if name not in left:
                raise CasacalError(f"'{name}' is both {change} and held (--fix)", "Give it in one of the two")
    return problem


def names_of(option: str, groups: Sequence[str]) -> list[str]:
    """Comma-separated names of an option that may be repeated; raises CasacalError where one is empty."""
    found = []
    for group in groups:
        names = [name.strip() for name in group.split(",") if name.strip()]
        if not names:
            raise CasacalError(f"{option} is empty", "Name something, or leave the option out")
        found += names
    return found


def stds_of(option: str, settings: Sequence[str], example: str) -> dict[str, float]:
    """Numbers (mm, rad; of any sign) by name from NAME=STD settings; raises CasacalError with the example."""
    return settings_of(option, settings, "NAME=STD", f"mm or rad, such as {example}", number)


def settings_of(
    option: str, settings: Sequence[str], form: str, example: str, read: Callable[[str], Read]
) -> dict[str, Read]:
    """Values by name of an option `NAME=VALUE`, each read by a function that raises ValueError."""
    found = dict[str, Read]()
    for setting in settings:
        name, _, value = setting.partition("=")
        if name.strip() in found:
            raise CasacalError(f"{option} gives '{name.strip()}' twice", "Give it once")
        try:
            found[name.strip()] = read(value)
        except (ValueError, argparse.ArgumentTypeError):
            raise CasacalError(f"{option} {setting} is not {form}", f"Give {example}") from None
    return found


def number(text: str) -> float:
    """A number, finite or not; raises ValueError for any other text."""
    if math.isnan(value := float(text)):
        raise ValueError(text)
    return value


def number_or_range(text: str) -> float | tuple[float, float]:
    """10, or -5:5; raises ArgumentTypeError for anything else, as argparse asks."""
    try:
        low, *high = (number(part) for part in text.split(":", 1))
        return (low, high[0]) if high else low
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is no number, nor a range of two such as -5:5") from None
