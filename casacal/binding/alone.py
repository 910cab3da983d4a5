"""Each of several instruments by itself, with the rows that it has."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from casacal.problem.problem import Problem
from casacal.samples.samples import Samples


@dataclass(frozen=True)
class Alone:
    """One instrument of a problem and its samples; the name is empty for an only one."""

    name: str
    problem: Problem
    samples: Samples


def each_alone(problem: Problem, samples: Sequence[Samples]) -> Iterator[Alone]:
    """The instruments of a problem one by one, in their order, each with its samples."""
    if len(samples) == 1:
        yield Alone("", problem, samples[0])
        return
    for name, some in zip(problem.names, samples, strict=True):
        yield Alone(name, problem.measured_by(name), some)
