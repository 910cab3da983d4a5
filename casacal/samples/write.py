"""Samples out: the form in which `read` takes them in."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from casacal.files import write_text
from casacal.samples.layout import Layout
from casacal.samples.samples import Samples
from casacal.values import EMPTY, FrozenMapping

WRITTEN = FrozenMapping({"angle": ("_deg", 180 / math.pi, 7), "length": ("_mm", 1.0, 4), "number": ("", 1.0, 9)})
"""How a quantity is written: the end of its column's name, the factor from rad or mm, and decimals."""
JOINT_DECIMALS = 7


def write_samples(path: str | Path, layout: Layout, samples: Samples, comments: Sequence[str]) -> None:
    """Write samples as a CSV file that `Problem.read` reads: angles in degrees, lengths in mm, numbers as they are.

    layout: what a problem asks of its samples, as `Problem.layout` says. comments: lines above the header. What touches
    of a plan are for stands beside them.
    """
    after = {name: [str(cell) for cell in samples.extra[name]] for name in ("purpose",) if name in samples.extra}
    write_text(path, samples_text(layout, samples, comments, after=after))


def samples_text(
    layout: Layout,
    samples: Samples,
    comments: Sequence[str],
    *,
    before: Mapping[str, Sequence[str]] = EMPTY,
    after: Mapping[str, Sequence[str]] = EMPTY,
    joint_decimals: int = JOINT_DECIMALS,
    least_decimals: int = 0,
    prefix: str = "",
) -> str:
    """The same as text.

    Args:
        layout, samples, comments: as of `write_samples`.
        before, after: further columns of cells (N,), by name.
        joint_decimals, least_decimals: of joint values, and of readings at least.
        prefix: what the names of readings begin with.

    """
    columns = dict(before)
    joints = zip(layout.joints, samples.joints.T, strict=True)
    quantities = [(f"q{i}", kind, values, joint_decimals) for i, (kind, values) in enumerate(joints, 1)]
    for name, kind in layout.columns.items():
        quantities.append((prefix + name, kind, samples.columns[name], max(WRITTEN[kind][2], least_decimals)))
    for name, kind, values, decimals in quantities:
        ending, factor, _ = WRITTEN[kind]
        columns[name + ending] = [f"{value:.{decimals}f}" for value in np.asarray(values) * factor]
    columns |= {name: list(labels) for name, labels in samples.labels.items()} | dict(after)
    text = io.StringIO()
    text.writelines(f"# {comment}\n" for comment in comments)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    return text.getvalue()
