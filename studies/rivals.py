"""The rivals of the paper's Table II, its controls and references, as the studies name them."""

from casacal import annealing, ekf, evolution, ipopt, lm, nominal, sckf, sckf_lm, swarm
from casacal.fit import null_step, plane_only, scipy_least_squares
from casacal.study import Method

BUDGETS = (10_000, 100_000, 1_000_000)
"""Rows of residuals that each population method may evaluate, each in a run of its own."""
POPULATION = {"M1 annealing": annealing, "M2 swarm": swarm, "M4 evolution": evolution}
LOCAL_SEARCH = "M1 annealing with local search, 1e5"
BEFORE, PLANES, EKF, SCKF, LM, BOTH = "before", "M0 planes only", "M3 EKF", "M5 SCKF", "M6 LM", "M7 SCKF+LM"
IPOPT, SCIPY, NULL_STEP = "IPOPT", "SciPy least_squares", "null-space step"

LOCAL = {EKF: ekf, SCKF: sckf, LM: lm, BOTH: sckf_lm}
"""Filters and Levenberg-Marquardt: M3, M5, M6, M7."""
CONTROLS = {BEFORE: nominal, PLANES: plane_only, NULL_STEP: Method(null_step, seeded=True)}
REFERENCES = {IPOPT: ipopt, SCIPY: scipy_least_squares}


def at_budget(name: str, budget: int | None) -> str:
    """What a population method is called at a budget of rows: "M2 swarm, 1e5", or "M2 swarm, until it stops"."""
    return f"{name}, until it stops" if budget is None else f"{name}, 1e{len(str(budget)) - 1}"


def population(trials: int, budgets: tuple[int, ...] = BUDGETS) -> dict[str, Method]:
    """M1, M2 and M4 at each budget, in some trials only."""
    return {
        at_budget(name, budget): Method(estimate, {"budget": budget}, seeded=True, trials=trials)
        for name, estimate in POPULATION.items()
        for budget in budgets
    }


def local_search(trials: int) -> dict[str, Method]:
    """M1 with SciPy's option to refine what it accepts, at the middle budget."""
    return {LOCAL_SEARCH: Method(annealing, {"budget": 100_000, "local_search": True}, seeded=True, trials=trials)}
