"""How near does the symbolic model come to C written by hand for one case?

One six-axis standard DH arm in contact with one plane, 27 unknowns. Kernels printed as C and replayed in blocks,
CasADi's plain map, SciPy and Ceres on the same kernels, filterpy's cubature filter, IPOPT with CasADi's own Hessian,
and the limit: C written by hand for exactly this case (studies/speed/limit.c, compiled by this study). All contenders
of a table take turns in one run, and only ratios of their medians travel to another machine.

    casacal study studies/speed.py [--quick] [--out DIR]
"""

from pathlib import Path

import numpy as np

from casacal import lm
from casacal.kernels.libraries import CompilerError
from casacal.study import Run
from studies import speed_contenders, speed_scale
from studies.reporting import figure, palette, save, script, table
from studies.speed_case import CANDIDATES, Case, agreement, case
from studies.speed_contenders import medians

TARGETS = (
    ("residual and Jacobian, c over C by hand, N = 10,000", "at most 1.9"),
    ("residual and Jacobian, c over C by hand past the caches, N = 100,000", "at most 1.35"),
    ("residual and Jacobian, blocks over C by hand, N = 10,000", "at most 14"),
    ("residual and Jacobian, blocks over C by hand, N = 100,000", "at most 9"),
    ("normal equations, c over C by hand, N = 10,000", "at most 1.15"),
    ("normal equations, c over C by hand, N = 100,000", "at most 1.15"),
    ("LM, Ceres over c, N = 120", "at least 3"),
    ("LM, SciPy lm with the same kernels over c, N = 120", "at least 8"),
    ("LM, Ceres with C kernels over blocks, N = 120", "above 1"),
    ("LM, c over C by hand, one thread, largest N", "at most 1.2"),
    ("LM, one thread over two threads, largest N", "at least 1.8"),
    ("SCKF, c over C by hand", "at most 4"),
    ("SCKF, blocks over C by hand", "at most 18"),
    ("SCKF, filterpy over c", "at least 50"),
    (f"{CANDIDATES} candidates, c over C by hand", "at most 1.5"),
    ("IPOPT, blocks over MX map and Hessian", "at most 0.1"),
)
"""What casacal was built to reach, so that the page says where it falls short."""


def report(run: Run) -> list[str]:
    """Tables of medians with ratios, growth with the number of rows, memory, and where it falls short."""
    sizes = (120, 1000) if run.quick else (120, 1000, 10_000, 100_000, 1_000_000)
    seconds = 0.1 if run.quick else 4.0
    cases = {rows: case(rows) for rows in sizes}
    try:
        agreed = agreement(cases[120])
    except CompilerError as error:
        return ["# Speed", "", f"There is no working C compiler here ({error}), so nothing was compared.", "",
                *table(("", ""), [])]  # fmt: skip
    lines = [*introduction(agreed, cases), ""]
    found: dict[str, dict[int, dict[str, float]]] = {}
    for title, contenders in speed_contenders.BY_ROWS.items():
        found[title] = {rows: medians(contenders(made), seconds) for rows, made in cases.items()}
        lines += [f"## {title}", "", *time_table(found[title]), ""]
    small = cases[120]
    for title, once in speed_contenders.AT_120.items():
        found[title] = {120: medians(once(small), seconds)}
        lines += [f"## {title}", "", *time_table(found[title]), ""]
    lines += ["## Against what was aimed at", "", *reached(found), ""]
    if not run.quick:
        lines += [*speed_scale.sections(), ""]
    draw({title: found[title] for title in speed_contenders.BY_ROWS}, run.out / "growth.png")
    return [*lines, "![time over the number of rows](growth.png)"]


def introduction(agreed: float, cases: dict[int, Case]) -> list[str]:
    """What is compared."""
    needed = ", ".join(f"{lm(made.best).residual_rows // rows} at {rows:,}" for rows, made in cases.items())
    return [
        "# How near the symbolic model comes to C by hand",
        "",
        "One six-axis standard DH arm in contact with one plane, 24 parameters, two tilts and an offset. Medians in",
        "microseconds, all contenders of a table in turns in one run; in brackets the ratio to the first. The C by",
        "hand writes into memory it was given, and its LM makes as many evaluations as casacal's needs from the",
        f"drawing ({needed} rows). Its results differ from casacal's by {agreed:.0e} at most (residuals in mm,",
        "Jacobian and filter relative). One thread, but where two are named.",
    ]


def time_table(found: dict[int, dict[str, float]]) -> list[str]:
    """Lines of a table of medians, each with its ratio to the first contender."""
    names = list(dict.fromkeys(name for times in found.values() for name in times))
    body = []
    for name in names:
        cells = []
        for times in found.values():
            first = next(iter(times.values()))
            cells.append(f"{1e6 * times[name]:,.3g} ({times[name] / first:.2f})" if name in times else "")
        body.append((name, *cells))
    return table(("us (ratio)", *(f"N = {rows:,}" for rows in found)), body)


def reached(found: dict[str, dict[int, dict[str, float]]]) -> list[str]:
    """Each aim beside what this run found."""
    names = speed_contenders
    slopes, normal, fits, filters, candidates, checks = found.values()

    def ratio(times: dict[str, float] | None, one: str, other: str) -> float:
        return times[one] / times[other] if times and one in times and other in times else float("nan")

    largest = fits[max(fits)]
    values = (
        ratio(slopes.get(10_000), names.PRINTED, names.LIMIT),
        ratio(slopes.get(100_000), names.PRINTED, names.PAST),
        ratio(slopes.get(10_000), names.BLOCKS, names.LIMIT),
        ratio(slopes.get(100_000), names.BLOCKS, names.LIMIT),
        ratio(normal.get(10_000), names.PRINTED, names.LIMIT),
        ratio(normal.get(100_000), names.PRINTED, names.LIMIT),
        ratio(fits[120], names.CERES, names.PRINTED),
        ratio(fits[120], names.SCIPY, names.PRINTED),
        ratio(fits[120], names.CERES, names.BLOCKS),
        ratio(largest, names.PRINTED, names.LIMIT),
        ratio(largest, names.PRINTED, names.TWO),
        ratio(filters[120], names.PRINTED, names.LIMIT),
        ratio(filters[120], names.BLOCKS, names.LIMIT),
        ratio(filters[120], names.FILTERPY, names.PRINTED),
        ratio(candidates[120], names.PRINTED, names.LIMIT),
        ratio(checks[120], names.CROSS_CHECK, names.MX_HESSIAN),
    )
    rows = [(what, aim, "-" if np.isnan(value) else f"{value:.3g}", judged(aim, value))
            for (what, aim), value in zip(TARGETS, values, strict=True)]  # fmt: skip
    return table(("ratio of medians", "aim", "found", ""), rows)


def judged(aim: str, value: float) -> str:
    """Whether a value is where it was aimed at."""
    if np.isnan(value):
        return "not measured"
    bound = float(aim.split()[-1])
    return "reached" if (value <= bound if aim.startswith("at most") else value >= bound) else "**missed**"


def draw(growth: dict[str, dict[int, dict[str, float]]], path: Path) -> None:
    """Time over the number of rows, one panel a task, with the exponent of each contender in the legend."""
    made = figure(13, 5.2)
    contenders = dict.fromkeys(name for found in growth.values() for times in found.values() for name in times)
    colours = dict(zip(contenders, palette(len(contenders)), strict=True))  # one contender, one colour in all panels
    for axes, (title, found) in zip(made.subplots(1, len(growth)), growth.items(), strict=True):
        for name in dict.fromkeys(name for times in found.values() for name in times):
            points = [(rows, times[name]) for rows, times in found.items() if name in times]
            rows, values = np.array(points).T
            exponent = np.polyfit(np.log(rows[-2:]), np.log(values[-2:]), 1)[0]
            axes.loglog(rows, values, "o-", ms=3, lw=1.2, color=colours[name],
                        label=f"{name}, N^{exponent:.2f}")  # fmt: skip
        axes.set_title(title, fontsize=10)
        axes.set_xlabel("rows")
        axes.legend(frameon=False, fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.16))
        axes.spines[["top", "right"]].set_visible(False)
    made.axes[0].set_ylabel("seconds")
    save(made, path)


if __name__ == "__main__":
    script(__file__)
