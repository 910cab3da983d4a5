"""Can a user put the symbols into a nonlinear program of their own, and does it find what the library finds?

An arm whose upper arm and forearm come from one mould: equally long, and nobody knows how long to a tenth. The user's
programs hold the library's rows as CasADi expressions, with a loss (Huber's) and a constraint (equal lengths) of their
own, each solved by two of CasADi's solvers: IPOPT with exact Hessians, and sqpmethod with Gauss-Newton's. They are
compared, in objective and estimate, with `lm`, with the library's own reference `ipopt`, and with `lm` on a problem
that has one unknown for both lengths.

    casacal study studies/own_nlp.py [--quick] [--trials N] [--workers N] [--out DIR]
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import casadi as ca
import numpy as np

from casacal import huber, ipopt, lm
from casacal.fit import LeastSquares
from casacal.study import Method, Run, Study
from casacal.study.statistics import Interval, mean_interval, paired, quantiles
from studies.own_nlp_arm import CELL, FITTED, FORE, THRESHOLD, TRUE, UPPER, Twins, tied
from studies.reporting import figure, number, save, script, table


class Loss(NamedTuple):
    """What a whitened residual costs, and the weight rho'(r) / r that its row has in Gauss-Newton; both elementwise."""

    cost: Callable[[ca.MX], ca.MX]
    weight: Callable[[ca.MX], ca.MX]


def rounded(r: ca.MX) -> ca.MX:
    """Huber's loss, as an expression."""
    size = ca.fabs(r)
    return ca.if_else(size <= THRESHOLD, r**2 / 2, THRESHOLD * (size - THRESHOLD / 2))


SQUARE = Loss(lambda r: r**2 / 2, lambda r: ca.MX.ones(r.shape))
HUBERS = Loss(rounded, lambda r: ca.if_else(ca.fabs(r) <= THRESHOLD, 1, THRESHOLD / ca.fabs(r)))


def equal_links(problem: LeastSquares, x: ca.MX) -> ca.MX:
    """What vanishes where both links are equally long, mm."""
    values = problem.symbolic.values(x)
    return values[UPPER] - values[FORE]


def by_ipopt(problem: LeastSquares, *, loss: Loss = SQUARE, equal: bool = False) -> np.ndarray:
    """The program in `casadi.Opti`, solved by IPOPT."""
    symbolic, opti = problem.symbolic, ca.Opti()
    y = opti.variable(problem.unknowns)
    x = symbolic.x0 + symbolic.start_std * y  # in units in which all unknowns are about one
    opti.minimize(ca.sum1(loss.cost(symbolic.residual(x))) + symbolic.prior(x))
    if equal:
        opti.subject_to(equal_links(problem, x) == 0)
    opti.solver("ipopt", {"print_time": False}, {"print_level": 0, "sb": "yes", "tol": 1e-9})
    return np.asarray(opti.solve().value(x))


def by_sqp(problem: LeastSquares, *, loss: Loss = SQUARE, equal: bool = False) -> np.ndarray:
    """The same as a plain nonlinear program, solved by sequential quadratic programs with Gauss-Newton's Hessian."""
    symbolic, n = problem.symbolic, problem.unknowns
    y, weight, dual = ca.MX.sym("y", n), ca.MX.sym("lam_f"), ca.MX.sym("lam_g", int(equal))
    scale = ca.DM(symbolic.start_std)
    x = symbolic.x0 + scale * y
    residual = symbolic.residual(x)
    slopes = ca.jacobian(residual, y)
    prior = ca.DM(problem.prior_information) * ca.mtimes(scale, scale.T)
    hessian = weight * (ca.mtimes(slopes.T, slopes * ca.repmat(loss.weight(residual), 1, n)) + prior)
    inputs = [y, ca.MX.sym("p", 0, 1), weight, dual]
    bend = ca.Function("nlp_hess_l", inputs, [hessian], ["x", "p", "lam_f", "lam_g"], ["hess_gamma_x_x"])
    program = {"x": y, "f": ca.sum1(loss.cost(residual)) + symbolic.prior(x)}
    if equal:
        program["g"] = equal_links(problem, x)
    silent = {"print_header": False, "print_iteration": False, "print_status": False, "print_time": False}
    quiet = {"print_iter": False, "print_header": False, "print_info": False}
    options = {"qpsol": "qrqp", "qpsol_options": quiet, "hess_lag": bend, "max_iter": 200, "tol_du": 1e-4, **silent}
    solver = ca.nlpsol("own", "sqpmethod", program, options)
    found = solver(x0=0, lbg=0, ubg=0)
    if not solver.stats()["success"]:
        raise ArithmeticError(solver.stats()["return_status"])
    return np.asarray(symbolic.x0 + scale * found["x"]).ravel()


CLEAN, GROSS = "as the model says", "5 % of rows gross, 1 mm"
SETTINGS = {
    CLEAN: Twins(TRUE, CELL, fitted=FITTED),
    GROSS: Twins(TRUE, dataclasses.replace(CELL, outliers=0.05, outlier_size=1.0), fitted=FITTED),
}
LM, HUBER, TIED = "LM", "LM, Huber", "LM, Huber, one unknown for both links"
OWN = {
    "square": ("own program", {}),
    "huber": ("own program, Huber", {"loss": HUBERS}),
    "equal": ("own program, Huber, equal links", {"loss": HUBERS, "equal": True}),
}
SOLVERS = {"IPOPT": by_ipopt, "SQP": by_sqp}
PROGRAMS = {
    f"{words}, {name}": (key, Method(solve, options))
    for key, (words, options) in OWN.items()
    for name, solve in SOLVERS.items()
}
METHODS = {
    LM: lm,
    "library's IPOPT": ipopt,
    HUBER: Method(lm, {"loss": huber(THRESHOLD)}),
    TIED: tied,
    **{name: method for name, (_, method) in PROGRAMS.items()},
}
AGAINST = {"library's IPOPT": "square", **{name: key for name, (key, _) in PROGRAMS.items()}}
"""Method to what it minimises, and so to the LM it is compared with."""
REFERENCE = {"square": LM, "huber": HUBER, "equal": TIED}

study = Study("own_nlp", SETTINGS, METHODS, trials=100, details=0)
quick = dataclasses.replace(study, trials=2)


def report(run: Run) -> list[str]:
    """Agreement in objective and estimate, then what loss and constraint are worth at the tip."""
    draw(run, run.out / "tip_errors.png")
    lines = [
        "# Programs of one's own, with the library's symbols",
        "",
        "Six-axis arm, simulated; upper arm and forearm equally long, each known to 0.7 mm beforehand; three",
        f"faces, 85 touches fitted, 35 held out, {run.study.trials} trials a setting. A program of one's own minimises",
        "`loss(symbolic.residual(x)) + symbolic.prior(x)`, with equal links as a constraint where it is said so. IPOPT",
        "runs with CasADi's exact Hessian, SQP (`sqpmethod` with `qrqp`) with Gauss-Newton's.",
        "",
        "## In short",
        "",
        *in_short(run),
        "",
        "![tip error of each method](tip_errors.png)",
        "",
        "## Agreement",
        "",
        "Over all trials. Gap: relative difference of the objective that the method minimises from that of the LM that",
        "it is compared with, lowest to highest; below zero the method goes lower than LM, which with Huber's loss",
        "stops a little early. Apart: largest difference of an unknown, in posterior standard deviations.",
        "",
        *agreement(run),
        "",
    ]
    for setting in run.study.settings:
        lines += [f"## {setting}", "", *tips(run, setting), ""]
    return lines[:-1]


def values(run: Run, method: str, name: str) -> np.ndarray:
    """A figure in all settings and trials in which the method did not fail."""
    found = np.concatenate([run.values(setting, method, name) for setting in run.study.settings])
    return found[np.isfinite(found)]


def mean(run: Run, setting: str, method: str) -> Interval:
    """Mean tip error over the trials in which the method did not fail, mm."""
    found = run.values(setting, method, "tip_rms_mm")
    return mean_interval(found[np.isfinite(found)])


def failed(run: Run, method: str) -> int:
    """Trials of all settings that failed."""
    return sum(len(run.failures(setting, method)) for setting in run.study.settings)


def agreement(run: Run) -> list[str]:
    """Every program beside the LM that minimises the same."""
    rows = [
        (method, REFERENCE[key], "{:+.0e} to {:+.0e}".format(*np.quantile(values(run, method, f"gap_{key}"), (0, 1))),
         f"{values(run, method, f'apart_{key}').max():.0e}", failed(run, method))
        for method, key in AGAINST.items()
    ]  # fmt: skip
    return table(("method", "compared with", "gap", "apart", "failures"), rows)


def tips(run: Run, setting: str) -> list[str]:
    """What each method makes of the arm, and how long it takes."""
    rows = []
    for method in run.study.methods:
        tip = run.values(setting, method, "tip_rms_mm")
        seconds = quantiles(run.values(setting, method, "solve", group="seconds"))[0]
        unequal = quantiles(run.values(setting, method, "unequal_mm"))[0]
        rows.append((method, mean(run, setting, method), paired(tip, run.values(setting, LM, "tip_rms_mm")).ratio,
                     "0" if unequal < 1e-7 else number(unequal), number(1000 * seconds)))  # fmt: skip
    header = ("method", "tip RMS, mm, mean", "over LM", "links apart, mm, median", "ms, median")
    return table(header, rows)


def in_short(run: Run) -> list[str]:
    """The figures in sentences."""
    gap = max(np.abs(values(run, method, f"gap_{key}")).max() for method, key in AGAINST.items())
    apart = max(values(run, method, f"apart_{key}").max() for method, key in AGAINST.items())
    failures = sum(failed(run, method) for method in AGAINST)
    total = len(AGAINST) * len(run.study.settings) * run.study.trials
    lines = [
        f"- The objectives of {len(AGAINST)} programs agree with LM's to {gap:.0e} of their size at most, the "
        f"estimates to {apart:.0e} posterior standard deviations; {failures} of {total} solves failed.",
    ]
    for setting in run.study.settings:
        base = run.values(setting, LM, "tip_rms_mm")
        ratios = {}
        for key, (words, _) in OWN.items():
            ratios[key] = paired(run.values(setting, f"{words}, IPOPT", "tip_rms_mm"), base).ratio
        lines.append(
            f"- **{setting}**: the tip error is {ratios['huber']} times LM's with the robust loss, and "
            f"{ratios['equal']} times with the loss and the constraint together."
        )
    return lines


def draw(run: Run, path: Path) -> None:
    """Tip error of each method, setting by setting."""
    made = figure(9, 4.5)
    axes = made.subplots()
    methods = list(run.study.methods)
    for place, (setting, colour) in enumerate(zip(run.study.settings, ("#2a6f97", "#d1622b"), strict=True)):
        found = [mean(run, setting, method) for method in methods]
        spans = np.array([[each.value - each.low, each.high - each.value] for each in found]).T
        height = np.arange(len(methods)) + 0.2 * (place - 0.5)
        axes.errorbar([each.value for each in found], height, xerr=spans, fmt="o", ms=4, color=colour, label=setting)
    axes.set_yticks(range(len(methods)), methods)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.set_xlabel("tip error over the workspace, mm RMS, mean and 95 % interval")
    axes.legend(frameon=False, fontsize=8)
    axes.spines[["top", "right"]].set_visible(False)
    save(made, path)


if __name__ == "__main__":
    script(__file__)
