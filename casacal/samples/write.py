"""Samples out: the form in which `read` takes them in."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from casacal.files import write_text
from casacal.samples.layout import Layout
from casacal.samples.samples import Samples
from casacal.values import FrozenMapping

WRITTEN = FrozenMapping({"angle": ("_deg", 180 / math.pi, 7), "length": ("_mm", 1.0, 4), "number": ("", 1.0, 9)})
"""How a quantity is written: the end of its column's name, the factor from rad or mm, and decimals."""
JOINT_DECIMALS = 7


def write_samples(path: str | Path, layout: Layout, samples: Samples, comments: Sequence[str]) -> None:
    """Write samples as a CSV file that `Problem.read` reads: angles in degrees, lengths in mm, numbers as they are.

    layout: what a problem asks of its samples, as `Problem.layout` says. comments: lines above the header.
    """
    header, columns = [], []
    joints = zip(layout.joints, samples.joints.T, strict=True)
    quantities = [(f"q{i}", kind, values, JOINT_DECIMALS) for i, (kind, values) in enumerate(joints, 1)]
    for name, kind in layout.columns.items():
        quantities.append((name, kind, samples.columns[name], WRITTEN[kind][2]))
    for name, kind, values, decimals in quantities:
        ending, factor, _ = WRITTEN[kind]
        header.append(name + ending)
        columns.append([f"{value:.{decimals}f}" for value in np.asarray(values) * factor])
    header += list(samples.labels)
    columns += [list(labels) for labels in samples.labels.values()]
    text = io.StringIO()
    text.writelines(f"# {comment}\n" for comment in comments)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows(zip(*columns, strict=True))
    write_text(path, text.getvalue())
