"""`casacal simulate`: simulate samples, with the true arm."""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from casacal.cli.cell import TABLE, TILT, in_cell, table_of
from casacal.cli.common import DONE, JSON, PROBLEM, add, number_or_range, spare, whole_number
from casacal.cli.terminal import answer
from casacal.errors import CasacalError
from casacal.wording import METRE, UNBOUNDED, counted, figures, listed, shortened

if TYPE_CHECKING:
    from casacal.data.samples import Samples
    from casacal.model.problem_file import ProblemFile
    from casacal.planning.route import Route
    from casacal.simulation.cell import Disturbances
    from casacal.simulation.simulate import Simulation

HELP = "simulate samples, with the true arm"

NUMBERS = {
    "repeatability": ("MM", "standard deviation of a reading, or of a touch where there is no dial"),
    "resolution": ("MM", "resolution of the dial; 0 for none"),
    "dial-gain": ("X", "error of the dial's gain, standard deviation: 0.0015 is 0.15 %%"),
    "dial-cycle": ("MM", "amplitude of the error that repeats with every turn of the pointer"),
    "hysteresis": ("MM", "hysteresis of the dial; readings lag by half of it"),
    "drift": ("MM", "drift of the readings from the first row to the last"),
    "joint-std": ("RAD", "repeatability of each joint, standard deviation"),
    "backlash": ("RAD", "backlash of each joint"),
    "encoder-step": ("RAD", "resolution of the joint values in the file"),
    "flatness": ("MM", "peak-to-valley form error of the faces"),
    "flatness-reach": ("X", "correlation length of the form error, in half widths of the face"),
    "compliance": ("MM", "RMS gravity sag of the tip"),
    "thermal": ("X", "thermal growth of the arm from the first row to the last: 3e-5 is 30 um per metre"),
    "outliers": ("F", "fraction of rows with a gross error"),
    "outlier-size": ("MM", "size of those errors"),
    "error-scale": ("X", "size of the arm's true errors, in prior standard deviations"),
}
"""Options that are a number: its unit, and what it is."""
SHOWN = 1e-3  # degrees, or hundredths of a mm, that a controller shows
MOVED = 10.0  # degrees, or tens of mm, beyond which a posture is another one than the plan's


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal simulate`."""
    parser.description = "Let a simulated arm, drawn at random from the problem's priors, touch the faces of a cell."
    add(parser, *PROBLEM)
    add(parser, "--out FILE", "samples to write, such as x.csv; the truth goes to x.truth.json", required=True)
    add(parser, "--samples N ...", "number of touches; default: 120; with several instruments dial=120, once for each")
    of_plan = "measure in the postures of what casacal plan wrote; touches kept to verify go to x_check.csv"
    add(parser, "--plan FILE", f"{of_plan}, as with measure")
    add(parser, "--seed K", "seed of arm, touches and noise; default: 0", kind=whole_number, default=0)
    words = "occasion on which the arm of that seed is measured: other noise, and without --plan other postures"
    add(parser, "--session K", f"{words}; default: 0", kind=whole_number, default=0)
    add(parser, "--travel MM", "range of the dial, such as 10 or -5:5", kind=number_or_range)
    add(parser, *TILT, kind=float)
    for name, (unit, words) in NUMBERS.items():
        add(parser, f"--{name} {unit}", words, kind=float)
    words = "transmission error of every turning joint, harmonic=amplitude in rad, such as 1=1e-4; may be repeated"
    add(parser, "--gear-wave ORDER=RAD ...", words, kind=_wave, dest="gear_waves")
    add(parser, *TABLE, kind=float)
    add(parser, "--repeats N", "touches of each place in a row", kind=whole_number)
    words = "side from which joints and plunger approach; same: from the row before, with the plunger pushed in"
    add(parser, "--approach", words, choices=("same", "alternating", "random"))
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Simulate as the options say; returns 0."""
    from casacal.calibration.truth import sample_paths, write_simulation
    from casacal.fit.bound_problem import bind
    from casacal.model.problem_file import load_problem
    from casacal.simulation.cell import Cell
    from casacal.simulation.simulate import simulate
    from casacal.uncertainty.tip_error import planned_accuracy

    out = Path(options.out)
    if out.suffix.lower() not in (".csv", ".txt", ""):
        what = f"simulate writes CSV, but '{out}' does not end in .csv"
        raise CasacalError(what, f"Name it {out.with_suffix('.csv').name}")
    source = load_problem(options.problem)
    route, cell = _route(source, options), _cell(source, options)
    checks = out.with_name(f"{out.stem}_check{out.suffix}")
    for place in (*sample_paths(out, source.problem.names), *([] if route is None else [checks])):
        spare([place, out.with_suffix(".truth.json")], *(file.path for file in source.files), options.plan)
    counts = _counts(source, options.samples) if route is None else route.samples
    simulation = simulate(source.problem, cell, samples=counts, seed=options.seed, session=options.session)
    lost, warned, remarks = _compared(route, simulation, cell)
    simulation, kept = _parted(simulation, route)
    before, after = planned_accuracy(bind(source.problem.without_terms, simulation.measured))
    paths = write_simulation(simulation, source, out, None if kept is None else (checks, kept))
    written = [path.as_posix() for path in paths]
    faces = [face.label for face in cell.faces] if isinstance(cell, Cell) else []
    found = {
        "samples": len(simulation.measured),
        "faces": faces,
        "tip": {"before_rms_mm": before, "after_rms_mm": after},
        "written": written,
    }
    if route is not None:
        found |= {"kept": 0 if kept is None else len(kept), "left_out": lost, "warnings": warned}
    sets = list(zip(source.problem.names, simulation.measured.sets, strict=True))
    counted = ", ".join(f"{len(some)} samples{f' of the {name}' if len(sets) > 1 else ''}" for name, some in sets)
    counted += "" if kept is None else f", and {len(kept)} kept to verify,"
    where = f"in the postures of {options.plan}" if options.plan else "in random postures"
    if options.plan is None and isinstance(cell, Cell):
        where = f"on {', '.join(faces)} at tilts up to {math.degrees(cell.tilt):g} deg"
    said = [f"Simulated, not measured: {counted} {where}", *(f"warning: {each}" for each in warned), *remarks]
    said.append(
        "Samples like these should reduce the tip error over the workspace, apart from the pose of the base, from "
        f"{f'{before:.2f}' if before < METRE else UNBOUNDED} to {after:.2f} mm RMS, if the stated noise and priors are "
        "right"
    )
    said += _not_simulated(simulation)
    if kept is None and checks.is_file() and checks.read_bytes().startswith(b"# simulated by casacal"):
        said.append(f"warning: {checks.as_posix()} is there from before; it is not of this simulation")
    answer(options, found, *said, f"Written: {', '.join(written)}")
    return DONE


def _route(source: ProblemFile, options: argparse.Namespace) -> Route | None:
    """The plan in whose postures to measure, if any."""
    from casacal.planning.route import CHECK, read_route, refuse_plan_of_another

    if options.plan is None:
        return None
    conflicting = [f"--{name}" for name in ("samples", "repeats", "tilt") if getattr(options, name)]
    if conflicting:
        raise CasacalError(f"Got --plan and {conflicting[0]}", "Give one of them: a plan says what is touched")
    if len(names := source.problem.names) > 1:
        what = f"A plan is of one instrument, and the problem has {', '.join(names)}"
        raise CasacalError(what, "Leave --plan out: simulate measures with all of them")
    found = read_route(options.plan, source.problem.layout())
    refuse_plan_of_another(options.plan, source.name, table_of(source, options))
    if set(found.purposes) == {CHECK}:
        raise CasacalError(f"All touches of {options.plan} are kept to verify", "Give a plan with touches to fit")
    return found


def _compared(
    route: Route | None, simulation: Simulation, cell: Disturbances
) -> tuple[list[int], list[str], list[str]]:
    """Numbers of planned touches that the true arm cannot make, warnings, and remarks on postures that were moved."""
    import numpy as np

    from casacal.planning.clearance import Clearance, hindered

    if route is None:
        return [], [], []
    made, robot, warned, remarks = simulation.samples, simulation.problem.robot, list[str](), list[str]()
    if found := hindered(simulation.problem, route.samples, cell.table, Clearance(cell.keep_out)):
        words = shortened((f"touch {number} ({hit})" for number, hit in found.items()), 6)
        warned.append(f"an arm cannot be in these postures of the plan: {words}")
    if lost := sorted(set(range(1, len(route) + 1)) - set(made.lines)):
        warned.append(
            f"{counted(len(lost), 'touch')} of the plan cannot be made by the true arm within the range of "
            f"joints and readings: {shortened(lost)}. Left out"
        )
    apart = np.abs(made.joints - route.samples.joints[np.array(made.lines) - 1])
    apart = (np.where(robot.revolute, np.degrees(apart), apart / 10)).max(axis=1)
    if moved := int((apart > SHOWN).sum()):
        or_mm = "" if robot.revolute.all() else f", or {figures(10 * apart.max(), 2)} mm"
        most = f"{figures(apart.max(), 2)} degrees{or_mm}"
        text = f"{counted(moved, 'posture')} moved by up to {most}, until the tip touched"
        remarks = [text + (" within the travel of the dial" if made.columns else "")]
        if apart.max() > MOVED:
            warned.append(f"{remarks.pop()}. The plan looks as if made for another arm, tool or cell")
    return lost, warned, remarks


def _parted(simulation: Simulation, route: Route | None) -> tuple[Simulation, Samples | None]:
    """The rows to fit, and those that the plan keeps to verify, if any."""
    import numpy as np

    from casacal.data.samples import Measurements
    from casacal.planning.route import CHECK

    if route is None:
        return simulation, None
    purposes = tuple(route.purposes[line - 1] for line in simulation.samples.lines)
    rows, kept = replace(simulation.samples, extra={"purpose": purposes}), np.array(purposes) == CHECK
    if kept.all():
        raise CasacalError(f"The true arm can make none of the touches to fit of {rows.file}", "Plan others")
    fit = replace(simulation, measured=Measurements.of(rows.take(np.flatnonzero(~kept))))
    return fit, rows.take(np.flatnonzero(kept)) if kept.any() else None


def _not_simulated(simulation: Simulation) -> list[str]:
    """Sentences on effects that are not simulated, and on those that the truth file does not hold."""
    said, columns = [], [name for effect in simulation.problem.terms for name in effect.further]
    if columns:
        fix = "To calibrate these samples, leave out the effects that need them"
        said.append(f"Not simulated: {listed(columns)}. {fix}")
    if simulation.moves_beyond_geometry:
        said.append(
            "The truth file holds the geometry alone. What else moves the tip, such as gravity sag and transmission "
            "error, is in Simulation.true_tips (Python)"
        )
    return said


def _counts(source: ProblemFile, texts: list[str]) -> dict[str, int]:
    """How many samples each instrument takes: N for all, or NAME=N for each."""
    names = source.problem.names
    found = dict.fromkeys(names, 120)
    for text in sorted(texts, key=lambda each: "=" in each):  # a number for one instrument overrides that for all
        name, equals, number = text.rpartition("=")
        try:
            count = int(number)
        except ValueError:
            wanted = "120" if len(names) == 1 else f"120, or {names[0]}=120"
            raise CasacalError(f"--samples {text} is not a number of samples", f"Give {wanted}") from None
        found |= dict.fromkeys([names[source.problem.number(name)]] if equals else names, count)
    return found


def _wave(text: str) -> tuple[int, float]:
    """Order and amplitude of a gear wave, as ORDER=RAD says them."""
    order, _, amplitude = text.partition("=")
    try:
        return int(order), float(amplitude)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is not ORDER=RAD, such as 1=1e-4") from None


def _cell(source: ProblemFile, options: argparse.Namespace) -> Disturbances:
    from casacal.simulation.cell import AMOUNTS, OF_FACES

    instrument, problem = source.problem.instruments[0], source.problem
    faced = [name for name, each in zip(problem.names, problem.instruments, strict=True) if each.probe is not None]
    named = [name.replace("_", "-") for name in OF_FACES if getattr(options, name) is not None]
    if named and not faced:
        raise CasacalError(f"--{named[0]} is about faces, and {type(instrument).__name__} touches none", "Leave it out")
    others = ("travel", "outliers", "outlier_size", "gear_waves", "repeats", "approach")
    values = {name: value for name in (*AMOUNTS, *others) if (value := getattr(options, name)) is not None}
    cell: Disturbances = in_cell(source, options, tilt=options.tilt).cell
    return replace(cell, **values)
