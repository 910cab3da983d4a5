"""Samples out: the form that `read` reads."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from casacal.files import write_text
from casacal.robots.robot import Robot
from casacal.samples.samples import Samples


def write_samples(path: str | Path, robot: Robot, samples: Samples, comments: Sequence[str]) -> None:
    """Write samples in the form `read_samples` reads: joints in degrees (prismatic: mm), readings in mm."""
    header = [f"q{i + 1}_{'deg' if turns else 'mm'}" for i, turns in enumerate(robot.revolute)]
    header += [f"{name}_mm" for name in samples.columns] + list(samples.labels)
    factors = np.where(robot.revolute, 180 / math.pi, 1.0)
    text = io.StringIO()
    text.writelines(f"# {comment}\n" for comment in comments)
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    for i in range(len(samples)):
        cells = [f"{value:.7f}" for value in samples.joints[i] * factors]
        cells += [f"{values[i]:.4f}" for values in samples.columns.values()]
        writer.writerow([*cells, *(labels[i] for labels in samples.labels.values())])
    write_text(path, text.getvalue())
