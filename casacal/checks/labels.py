"""What labels say of themselves: columns of them that are absent, labels that are rare, or slips of others."""

from __future__ import annotations

from collections import Counter, defaultdict
from itertools import combinations

import numpy as np

from casacal.checks.finding import Finding
from casacal.problem.problem import Problem
from casacal.samples.samples import Samples
from casacal.tables.grammar import is_number
from casacal.wording import counted, shortened

LABELS_ALIKE = "labels alike"
LOST_STEP = "step without a face"
MARGIN = 2  # rows that a label needs beside one for each unknown of its own
RARE = 0.03
FEW = 3  # a label of no more rows, in no more than this part of all, is rare
SHORTEST = 4  # letters from which one letter more or less is a slip and not another name
MOST_LABELS = 200  # labels that are compared with one another; where there are more they are numbers, not names


def absent_labels(problem: Problem, samples: Samples) -> list[Finding]:
    """Warnings on columns by which a problem declares its unknowns to differ, and which the samples do not have.

    Columns by which an instrument's unknowns differ anyhow, such as `plane`, may be left out where there is one.
    """
    found = []
    for key, unknown in problem.instrument.unknowns.items():
        usual = getattr(getattr(type(problem.instrument), key, None), "per", None)
        column = unknown.per
        if column is not None and column != usual and samples.labels[column].names == (column,):
            cause = (
                f"there is no column '{column}', which '{key}' is declared to depend on; all rows count as one group"
            )
            found.append(Finding("warning", "labels absent", cause, f"Add the column, or declare '{key}' without it"))
    return found


def lost_steps(problem: Problem, samples: Samples) -> list[Finding]:
    """Errors on steps in rows that stand on a face without rows, warnings of steps that no row is on."""
    probe = problem.instrument.probe
    names = () if probe is None or probe.label is None else samples.faces(probe.label).names
    if probe is None or names in ((), (probe.label,)):
        return []
    found, there = [], f"The labels there are: {shortened(names)}"
    for step in probe.steps:
        on = problem.instrument.instance("plane", step)
        if step in names and on not in names:
            cause = f"'{step}' is declared to stand on '{on}', and no row is on '{on}', so its height tells nothing"
            found.append(Finding("error", LOST_STEP, cause, f"Correct the step in the problem, or the labels. {there}"))
        elif step not in names:
            cause = f"'{step}' is declared as a step on '{on}', and no row is on '{step}', so its height tells nothing"
            found.append(Finding("warning", LOST_STEP, cause, f"Touch it, or correct the label. {there}"))
    return found


def odd_labels(problem: Problem, samples: Samples) -> list[Finding]:
    """Warnings on labels that occur in few rows or hardly differ from another one; a label is named once."""
    column = problem.instrument.groups
    if column is None or column not in samples.labels:
        return []
    labels = samples.labels[column]
    counts = dict(zip(labels.names, np.bincount(labels.codes, minlength=len(labels.names)).tolist(), strict=True))
    declared = {label for known in problem.instrument.known_columns.values() for label in known}
    alike = _alike(counts) if len(counts) <= MOST_LABELS else {}
    findings, totals = [], _rows_of_unknowns(problem, counts, column)
    for name, rows in labels.rows().items():
        if name in declared:
            continue
        lines = tuple(samples.lines[i] for i in rows.tolist())
        if name in alike:
            other = alike[name]
            cause = f"'{name}' ({counted(counts[name])}) hardly differs from '{other}' ({counted(counts[other])})"
            what = problem.instrument.words.group
            fix = f"Write '{other}' there if it is the same {what}; now it counts as a separate {what}"
            findings.append(Finding("warning", LABELS_ALIKE, cause, fix, lines))
        elif said := _rare(problem, name, counts, column, totals.get(name, counts[name])):
            findings.append(Finding("warning", "rare label", *said, lines))
    return findings


def _rare(problem: Problem, name: str, counts: dict[str, int], column: str, total: int) -> tuple[str, str] | None:
    """Cause and fix for a label of too few rows; None where it has enough."""
    instrument = problem.instrument
    own = sum(  # of the instrument, which it has for itself: none where it shares the plane of another one
        unknown.size
        for key, unknown in instrument.unknowns.items()
        if unknown.per == column and instrument.instance(key, name) == name
    )
    group, components = instrument.words.group, problem.models[0].components
    few = own > 0 and total * components < own + MARGIN
    rare = len(counts) > 1 and counts[name] <= FEW and counts[name] < RARE * sum(counts.values())
    if not few and not rare:
        return None
    others = [repr(other) for other in counts if other != name]
    slip = f"Correct it if you mean {' or '.join(others[:FEW])}, or take" if others else "Take"
    beside = f"; each {group} has {counted(own, 'unknown')} of its own" if own else ""
    least = -(-(own + MARGIN) // components)
    return f"'{name}' occurs in {counted(counts[name])}{beside}", f"{slip} {least} rows or more there"


def _alike(counts: dict[str, int]) -> dict[str, str]:
    """For each label that looks like a slip of another one, that other one: of two, the one of fewer rows."""
    close: dict[str, list[str]] = defaultdict(list)
    for one, two in combinations(counts, 2):
        rare, often = (one, two) if counts[one] < counts[two] else (two, one)
        if _slip(rare, often, both_common=2 * counts[rare] > counts[often]):
            close[rare].append(often)
    return {name: max(others, key=lambda other: counts[other]) for name, others in close.items()}


def _slip(one: str, two: str, *, both_common: bool) -> bool:
    """Whether two labels differ by case, blanks or one letter; 'face1' and 'face2' do not, nor 'sideA' and 'sideB'."""
    if "".join(one.split()).casefold() == "".join(two.split()).casefold():
        return True
    if is_number(one) and is_number(two):
        return float(one.replace(",", ".")) == float(two.replace(",", "."))  # 1 beside 1.0, as a spreadsheet makes it
    short, long = sorted((one.casefold(), two.casefold()), key=len)
    if len(short) < SHORTEST - 1 or len(long) < SHORTEST or len(long) - len(short) > 1:
        return False
    start = next((i for i, (a, b) in enumerate(zip(short, long, strict=False)) if a != b), len(short))
    if len(short) == len(long):
        if short[start + 1 :] != long[start + 1 :] or not (short[start].isalpha() and long[start].isalpha()):
            return False
        return not (both_common and start == len(short) - 1)
    return short[start:] == long[start + 1 :] and long[start].isalpha()


def _rows_of_unknowns(problem: Problem, counts: dict[str, int], column: str) -> dict[str, int]:
    """Rows that tell of each label's unknowns: its own, and those of labels that share them, such as a step's."""
    instrument, fewest = problem.instrument, dict[str, int]()
    for key in (key for key, unknown in instrument.unknowns.items() if unknown.per == column):
        totals = Counter[str]()
        for name, count in counts.items():
            totals[instrument.instance(key, name)] += count
        for name in counts:
            fewest[name] = min(fewest.get(name, totals[name]), totals[name])
    return fewest
