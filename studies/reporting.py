"""What all studies share: where a report goes and what it says of its own making."""

import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

HERE = Path(__file__).parent
PROBLEMS = HERE.parent / "problems"


def figure(width: float, height: float) -> Figure:
    """A figure that needs no display."""
    made = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(made)
    return made


def save(made: Figure, path: Path) -> None:
    """Write a PNG; the same figure gives the same bytes."""
    made.savefig(path, dpi=150, metadata={"Software": None})


def table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> list[str]:
    """Lines of a Markdown table."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    return lines + ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows]


def write(out: Path, lines: Sequence[str], command: str) -> None:
    """Write report.md with the command, the versions and the kind of machine that made it."""
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("casacal", "casadi", "numpy", "scipy"))
    made = f"Made by `{command}` with {versions}, Python {platform.python_version()} on {platform.machine()}."
    out.mkdir(parents=True, exist_ok=True)
    (out / "report.md").write_text("\n".join([*lines, "", made]) + "\n", encoding="utf-8")
