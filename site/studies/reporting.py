"""What all studies share: figures, tables, and running as a script."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from casacal.cli.main import main
from casacal.study.statistics import Interval

PROBLEMS = Path(__file__).parent.parent / "problems"


def script(file: str) -> None:
    """Run a study file as `casacal study FILE` with the arguments of this process, and end with its exit code."""
    sys.exit(main(["study", file, *sys.argv[1:]]))


def figure(width: float, height: float) -> Figure:
    """A figure that needs no display."""
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def save(made: Figure, path: Path) -> None:
    """Write a picture of the kind that the name says; the same figure gives the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context({"svg.hashsalt": "casacal"}):
        made.savefig(path, dpi=110, metadata={"Date": None} if path.suffix == ".svg" else {"Software": None})


def save_both(made: Figure, path: Path) -> None:
    """Write NAME.png and NAME.svg."""
    for suffix in (".png", ".svg"):
        save(made, path.with_suffix(suffix))
        made.set_layout_engine("none")  # laid out once: it takes longer than drawing


def palette(count: int) -> list[str]:
    """So many colours that can be told apart, also by those who see few."""
    wheel = [
        "#123a63",
        "#d1622b",
        "#3aa28f",
        "#a8577e",
        "#e0a030",
        "#5b4a9e",
        "#7a9a3a",
        "#8c8c8c",
        "#1f6fb2",
        "#c02020",
    ]
    return [wheel[k % len(wheel)] for k in range(count)]


def shared_legend(made: Figure, columns: int) -> None:
    """One legend for all panels, below them, each label once."""
    entries: dict[str, Any] = {}
    for axes in made.axes:
        handles, labels = axes.get_legend_handles_labels()
        entries |= {label: handle for label, handle in zip(labels, handles, strict=True) if label not in entries}
    made.legend(entries.values(), entries.keys(), frameon=False, fontsize=8, loc="outside lower center", ncols=columns)


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    """Lines of a Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return lines + ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]


def percent(rate: Interval) -> str:
    """A rate with its interval, in percent."""
    return f"{100 * rate.value:.1f} % ({100 * rate.low:.1f} to {100 * rate.high:.1f})"


def number(value: float, digits: int = 3) -> str:
    """A figure with as many digits as mean something; a dash where there is none."""
    if value != value:
        return "-"
    if value != 0 and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.{digits - 1}e}"
    shown = f"{value:.{digits}g}"
    return f"{float(shown):,.0f}" if "e" in shown or abs(value) >= 1000 else shown
