"""`casacal check`: find mistakes in samples before fitting."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from casacal.cli.common import DONE, FAILED, JSON, PROBLEM, add, add_adjustments, add_samples, adjusted, read_samples
from casacal.cli.terminal import answer
from casacal.wording import counted

HELP = "find mistakes in samples before fitting"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `casacal check`."""
    parser.description = "Find mistakes and weaknesses in samples. Exit 1 if a result from them would be wrong."
    add(parser, *PROBLEM)
    add_samples(parser)
    add_adjustments(parser)
    add(parser, *JSON)


def run(options: argparse.Namespace) -> int:
    """Check as the options say; returns 0, or 1 when a result would be wrong."""
    from casacal.calibration.check import check
    from casacal.model.problem_file import load_problem

    source = load_problem(options.problem)
    samples = read_samples(source, options, absurd=True)
    findings = check(adjusted(source.problem, options), samples, confirmed=source.confirmed)
    counts = {word: sum(f.severity == word for f in findings) for word in ("error", "warning", "remark")}
    data = {"file": samples.file, "sha256": samples.sha256, "samples": len(samples)}
    found = {"problem": source.name, "data": data, "counts": counts, "findings": [asdict(f) for f in findings]}
    said = ", ".join(counted(count, word) for word, count in counts.items())
    answer(options, found, *map(str, findings), f"{len(samples)} samples of {samples.file}: {said}")
    return FAILED if counts["error"] else DONE
