"""The touches of a plan in `casacal simulate`: read, compared with what the true arm could make, and parted."""

from __future__ import annotations

import argparse
from dataclasses import replace
from typing import TYPE_CHECKING

from casacal.cli.adjust import table_of
from casacal.errors import CasacalError

if TYPE_CHECKING:
    from casacal.planning.route import Route
    from casacal.problem.problem_file import ProblemFile
    from casacal.robots.robot import Robot
    from casacal.samples.samples import Samples
    from casacal.simulation.simulate import Simulation


def route_of(source: ProblemFile, options: argparse.Namespace) -> Route | None:
    """The plan in whose postures to measure, if any."""
    from casacal.planning.route import CHECK, read_route, refuse_plan_of_another

    if options.plan is None:
        return None
    asked = [f"--{name}" for name in ("samples", "repeats", "tilt") if getattr(options, name)]
    if asked:
        raise CasacalError(f"Got --plan and {asked[0]}", "Give one of them: a plan says what is touched")
    if len(names := source.problem.names) > 1:
        what = f"A plan is of one instrument, and the problem has {', '.join(names)}"
        raise CasacalError(what, "Leave --plan out: simulate measures with all of them")
    found = read_route(options.plan, source.problem.layout())
    refuse_plan_of_another(options.plan, source.name, table_of(source, options))
    if set(found.purposes) == {CHECK}:
        raise CasacalError(f"All touches of {options.plan} are kept to verify", "Give a plan with touches to fit")
    return found


def parted(simulation: Simulation, route: Route | None) -> tuple[Simulation, Samples | None]:
    """What is to be fitted, and the rows that the plan keeps to verify, if any."""
    from casacal.planning.route import CHECK
    from casacal.samples.measurements import Measurements

    if route is None:
        return simulation, None
    rows = simulation.samples
    purposes = tuple(route.purposes[line - 1] for line in rows.lines)
    rows = replace(rows, extra={"purpose": purposes})
    check = [k for k, purpose in enumerate(purposes) if purpose == CHECK]
    fit = [k for k, purpose in enumerate(purposes) if purpose != CHECK]
    if not fit:
        raise CasacalError(f"The true arm can make none of the touches to fit of {rows.file}", "Plan others")
    return replace(simulation, measured=Measurements.of(rows.take(fit))), rows.take(check) if check else None


def left_out(route: Route, made: Samples) -> list[int]:
    """Numbers of the touches of a plan that the true arm could not make."""
    return sorted(set(range(1, len(route) + 1)) - set(made.lines))


SEEN = 1e-3  # degrees, or hundredths of a mm, that a controller shows
MOVED = 10.0  # degrees, or tens of mm, beyond which a posture is another one than the plan's


def compared(route: Route, made: Samples, robot: Robot) -> tuple[list[str], list[str]]:
    """Touches of a plan that were left out, and how far others were moved until they touched: warnings and remarks."""
    import numpy as np

    from casacal.wording import counted, shortened

    warned, remarks = list[str](), list[str]()
    if lost := left_out(route, made):
        numbers = shortened([str(number) for number in lost])
        warned.append(
            f"{counted(len(lost), 'touch')} of the plan cannot be made by the true arm within the range of "
            f"joints and readings: {numbers}. Left out"
        )
    apart = np.abs(made.joints - route.samples.joints[np.array(made.lines) - 1])
    apart = (np.where(robot.revolute, np.degrees(apart), apart / 10)).max(axis=1)
    if moved := int((apart > SEEN).sum()):
        most = f"{apart.max():.2g} degrees" + ("" if robot.revolute.all() else f", or {10 * apart.max():.2g} mm")
        text = f"{counted(moved, 'posture')} moved by up to {most}, until the tip touched"
        text += " within the travel of the dial" if made.columns else ""
        if apart.max() > MOVED:
            warned.append(f"{text}. The plan looks as if made for another arm, tool or cell")
        else:
            remarks.append(text)
    return warned, remarks
