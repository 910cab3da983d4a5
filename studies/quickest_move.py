"""What does the quickest move to a point miss that is planned with the arm as drawn, and what with the calibrated one?

A UR5 is to bring its tip from rest at one touch to rest at a point of the work, as fast as the limits of its joints
allow: an optimal-control problem over joint accelerations, with the tip as a CasADi function in `casadi.Opti`. Both
arms plan the same way; the true arm executes the plan. Where the work stands each arm knows from three marks that it
was jogged to, as one teaches a work object, so that nobody is blamed for where the base stands.

    casacal study studies/quickest_move.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

from casacal import lm, load_problem, nominal
from casacal.fit import Result
from casacal.simulation.trials import Simulated, SimulatedTrial
from casacal.study import Method, Run, Study
from casacal.study.statistics import mean_interval, quantiles
from studies.reporting import PROBLEMS, figure, number, palette, save, script, table

STEPS = 20
SPEED = 3.0
"""Largest speed of a joint, rad/s."""
PUSH = 8.0
"""Largest acceleration of a joint, rad/s^2."""
SMOOTH = 1e-3
"""Seconds that (1 rad/s^2)^2 for a second is worth: of the moves that are as quick, the calm one."""
DRAWN, CALIBRATED = "as drawn", "calibrated"


@dataclass(frozen=True)
class Plan:
    """A move: joint values (STEPS + 1, n; rad) at equal times, and how long it takes, s."""

    joints: np.ndarray
    seconds: float


def quickest(tip: ca.Function, start: np.ndarray, target: np.ndarray) -> Plan:
    """The quickest move from rest at joint values (n; rad) to rest with the tip at a target (3; mm).

    tip: of joint values, such as `calibration.tip_function()`. Accelerations are constant over each of the steps.
    """
    opti = ca.Opti()
    total, n = opti.variable(), len(start)
    q, v, a = (opti.variable(n, count) for count in (STEPS + 1, STEPS + 1, STEPS))
    h = total / STEPS
    opti.minimize(total + SMOOTH * h * ca.sumsqr(a))
    opti.subject_to(q[:, 1:] == q[:, :-1] + h * v[:, :-1] + h**2 / 2 * a)
    opti.subject_to(v[:, 1:] == v[:, :-1] + h * a)
    opti.subject_to(opti.bounded(-SPEED, ca.vec(v), SPEED))
    opti.subject_to(opti.bounded(-PUSH, ca.vec(a), PUSH))
    opti.subject_to(q[:, 0] == start)
    opti.subject_to(v[:, 0] == 0)
    opti.subject_to(v[:, -1] == 0)
    opti.subject_to(tip(q[:, -1]) / 1000 == target / 1000)  # metres, near one as all else
    opti.subject_to(opti.bounded(0.05, total, 10.0))
    opti.set_initial(total, 1.0)
    opti.set_initial(q, np.tile(start, (STEPS + 1, 1)).T)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "tol": 1e-9})
    found = opti.solve()
    return Plan(np.asarray(found.value(q)).T, float(found.value(total)))


def frame_of(points: np.ndarray) -> np.ndarray:
    """Frame (4, 4) of three points (3, 3): origin in the first, x to the second, the third in its plane of x and y."""
    x = points[1] - points[0]
    z = np.cross(x, points[2] - points[0])
    axes = np.column_stack([each / np.linalg.norm(each) for each in (x, np.cross(z, x), z)])
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = axes, points[0]
    return frame


@dataclass(frozen=True)
class Move(SimulatedTrial):
    """A simulated arm that is to move; whoever estimates it plans with the estimate, and the true arm moves."""

    def judge(self, result: Result) -> dict[str, float]:
        """How far from the point the true tip comes to rest (mm), how long the move takes (s), and the tip error."""
        touches = self.heldout.block.samples.joints[:4]  # three marks, and where the point is
        known, true = (self.problem.tips(x, touches) for x in (result.x, self.truth))
        on_work = np.linalg.inv(frame_of(true[:3])) @ [*true[3], 1.0]  # what the drawing of the work says of the point
        target = (frame_of(known[:3]) @ on_work)[:3]
        plan = quickest(self.tip_function(result.x), touches[0], target)
        planned, end = (self.problem.tips(x, plan.joints[-1:])[0] for x in (result.x, self.truth))
        return {
            "miss_mm": float(np.linalg.norm(end - true[3])),
            "planned_um": 1000 * float(np.linalg.norm(planned - target)),
            "move_s": plan.seconds,
            "tip_rms_mm": super().judge(result)["tip_rms_mm"],
        }

    def tip_function(self, x: np.ndarray) -> ca.Function:
        """q -> tip (3; mm) of the arm at unknowns x (n,), as `tip_function` of a calibration gives it."""
        symbols, kind = self.problem.problem.symbols, self.problem.symbolic.kinds[0]
        q = ca.SX.sym("q", symbols.q.numel())
        row = ca.vertcat(q, ca.DM.zeros(len(symbols.columns)))
        return ca.Function("tip", [q], [symbols.functions["tip"](x[kind.columns], kind.constants, row)])


@dataclass(frozen=True)
class MovingCell(Simulated):
    """A simulated cell whose arm is to move."""

    def trial(self, seed: int) -> Move:
        """One arm; the same for the same seed."""
        made = super().trial(seed)
        return Move(made.problem, made.heldout, made.truth)


source = load_problem(PROBLEMS / "ur5")
METHODS = {DRAWN: Method(nominal), CALIBRATED: Method(lm)}
study = Study("quickest_move", {"ur5": MovingCell(source.problem, source.cell)}, METHODS, trials=50, details=0)
quick = dataclasses.replace(study, trials=2)


def report(run: Run) -> list[str]:
    """How far each arm's plan misses."""
    draw(run, run.out / "misses.png")
    rows = []
    for method in METHODS:
        misses, errors, seconds = (run.values("ur5", method, name) for name in ("miss_mm", "tip_rms_mm", "move_s"))
        rows.append(
            (
                method,
                mean_interval(misses),
                number(quantiles(misses)[1]),
                mean_interval(errors),
                number(float(np.mean(seconds))),
            )
        )
    worst = max(float(run.values("ur5", method, "planned_um").max()) for method in METHODS)
    header = ("planned with the arm", "miss, mm", "95 % below, mm", "tip error, mm RMS", "move, s")
    return [
        "# What the quickest move misses",
        "",
        f"{run.study.trials} simulated UR5s in the cell of their problem, calibrated from 85 touches. Each is to bring",
        "its tip from rest at one touch to rest at a point of the work, in the least time that joint speeds of",
        f"{SPEED:g} rad/s and accelerations of {PUSH:g} rad/s^2 allow: an optimal-control problem of {STEPS} steps, in",
        "which the tip is the CasADi function of the arm. The true arm executes the plan. Three marks of the work,",
        "which the arm was jogged to, say where the work stands, so that the position of the base plays no part. Means",
        "with 95 % intervals.",
        "",
        *table(header, rows),
        "",
        f"Every plan ends within {number(worst, 2)} um of its target, as its own arm sees it: what is missed is the",
        "error of that arm.",
        "",
        "![how far each plan misses, one dot a trial](misses.png)",
    ]


def draw(run: Run, path: Path) -> None:
    """Misses of both, one dot a trial."""
    made = figure(6, 4)
    axes = made.subplots()
    drawn, known = (run.values("ur5", method, "miss_mm") for method in METHODS)
    axes.plot(drawn, known, "o", color=palette(1)[0], ms=4)
    axes.set_xlabel("miss of the plan with the arm as drawn, mm")
    axes.set_ylabel("with the calibrated arm, mm")
    axes.set_ylim(0)
    axes.set_xlim(0)
    save(made, path)


if __name__ == "__main__":
    script(__file__)
