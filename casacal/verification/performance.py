"""ISO 9283:1998, clauses 7.2, 7.3, 8.2, 8.3: how accurate and how repeatable poses, distances and a path are."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from casacal.data.archives import table_of_frame
from casacal.data.samples import Layout, is_frame, match_columns, read_any_table
from casacal.data.text import Table
from casacal.errors import CasacalError, SamplesError, came
from casacal.model.geometry import rigid_fit
from casacal.model.kinematics import quaternions_of
from casacal.values import Array, FrozenMapping, Value
from casacal.verification.cube import CYCLE, CYCLES, FLANGE, PATH_CYCLES, CubePlan
from casacal.wording import counted, listed

COORDINATES = "x", "y", "z"
QUATERNION = "qx", "qy", "qz", "qw"
GROSS = 0.05  # of the largest distance between points: nobody's arm errs by so much
UNITS = {"m": 1e-3, "in": 1 / 25.4, "um": 1e3}  # what rows in these units shrink to, or grow
LIKE = 1.1  # factor within which a cube has another's size
TILTED = math.radians(5)  # beyond which a body's axes are not the flange's


@dataclass(frozen=True)
class Criterion:
    """A figure in mm, or in degrees ("deg"), its standard error by the jackknife (NaN for two cycles)."""

    value: float
    std: float
    cycles: int
    unit: Literal["mm", "deg"] = "mm"


@dataclass(frozen=True, eq=False)
class PoseAccuracy(Value):
    """Figures of ISO 9283 by name, such as "AP P1", "RP P1", "AD", "RD", "AT", "RT".

    AP is followed by its components "APx P1", ...; "RPa P1", "RPb P1" and "RPc P1" are of orientations about x, y and
    z, "3s P1" of a dial's readings. frame: in which the rows were judged: "base", "fitted" to the commanded points, or
    "none". missing: lines without a measurement. notes: sentences on what the figures hold, and what cannot be told.
    """

    criteria: Mapping[str, Criterion]
    frame: Literal["base", "fitted", "none"]
    missing: int
    notes: tuple[str, ...]
    file: str

    def to_dict(self) -> dict[str, Any]:
        """The figures and notes as a document for JSON."""
        criteria, notes = {name: vars(each) for name, each in self.criteria.items()}, list(self.notes)
        return {"criteria": criteria, "frame": self.frame, "missing": self.missing, "notes": notes, "file": self.file}

    def table(self, before: PoseAccuracy | None = None) -> list[tuple[str, Criterion, Criterion | None, float | None]]:
        """Name, figure, figure before and the ratio of their sizes for each name, in their order; None where none was.

        There is no ratio to a figure before that is smaller than twice its standard error.
        """
        rows = list[tuple[str, Criterion, Criterion | None, float | None]]()
        for name, now in self.criteria.items():
            then = None if before is None else before.criteria.get(name)
            told = then is not None and abs(then.value) > 2 * then.std
            rows.append((name, now, then, abs(now.value / then.value) if then is not None and told else None))
        return rows


def pose_accuracy(
    targets: CubePlan | str | Path | Mapping[str, Sequence[float]], measured: str | Path | Any, *, in_base: bool = False
) -> PoseAccuracy:
    """How accurate and repeatable an arm is by ISO 9283, from what was measured at its commanded points.

    AP is the distance from the commanded point to the barycentre of those attained, RP their mean distance from it and
    three standard deviations (7.2). AD is the mean distance of P2 and P4 less the commanded one, RD three standard
    deviations (7.3). AT and RT are the largest AP and RP in the normal planes of the path (8.2, 8.3).

    Args:
        targets: what `plan_cube` returned, its file, points (3,; mm) by name, or a CSV with point,x_mm,y_mm,z_mm.
        measured: a file or DataFrame with x_mm, y_mm, z_mm, `point` and `cycle`. Without `point` rows are P5 to P1 over
            and over; without `cycle` one begins where the order of points does. qw, qx, qy, qz give orientations. A
            column reading_mm in place of the three is a dial's, of which only scatter along its axis is told.
        in_base: the coordinates are in the base frame. Otherwise they are fitted rigidly to the commanded points.

    Raises SamplesError for rows that are not of these points, in other units, or too few; CasacalError for no targets.

    """
    commanded, turns = _commanded(targets)
    rows = _Rows.of(_table(measured), [*commanded])
    notes = [f"{counted(rows.missing, 'line')} without a measurement"] if rows.missing else []
    sets = {name: rows.of_point(name) for name in commanded if not OF_PATH.fullmatch(name)}
    kept = {name: each for name, each in sets.items() if len(each) >= 2}
    if once := [name for name in sets if name not in kept]:
        notes.append(f"{listed(once)}: fewer than two measurements, so left out")
    if not kept and len(rows.paths()) < 2:
        raise SamplesError(rows.file, "no point was measured in two cycles", "Measure each in 30, and in 2 at least")
    if rows.values.shape[1] == 1:
        return _of_dial(rows, kept, notes)
    frame, kind = _frame(rows, commanded, kept, in_base, notes)
    criteria = dict[str, Criterion]()
    for name, each in kept.items():
        attained = rows.values[list(each.values())]
        if frame is not None and kind == "base":
            off = attained @ frame[:3, :3].T + frame[:3, 3] - commanded[name]
            criteria[f"AP {name}"] = _criterion(accuracy, off)
            criteria |= {f"AP{'xyz'[k]} {name}": _criterion(np.mean, off[:, k]) for k in range(3)}
        elif frame is not None:
            criteria |= _fitted_accuracy(rows, commanded, kept, name)
        criteria[f"RP {name}"] = _criterion(repeatability, attained)
    if rows.turns is not None and frame is not None:
        criteria |= _orientations(rows, kept, frame[:3, :3], turns if in_base else {}, notes)
    criteria |= _distance(rows, commanded, kept, notes)
    if frame is not None:
        criteria |= _path(rows, commanded, frame, notes)
    short = [n for name, each in criteria.items() if (n := each.cycles) < (PATH_CYCLES if name[1:] == "T" else CYCLES)]
    if short:
        asked = f"{CYCLES} cycles of poses and {PATH_CYCLES} of a path"
        notes.append(f"ISO 9283 asks for {asked}; some of these are of {min(short)}")
    return PoseAccuracy(FrozenMapping(criteria), kind, rows.missing, tuple(notes), rows.file)


OF_PATH = re.compile(r"L\d*")  # points of the path, as `plan_cube` names them


def accuracy(off: Array) -> float:
    """AP (7.2.1): distance of the barycentre of deviations (n, 3) from zero."""
    return float(np.linalg.norm(off.mean(axis=0)))


def repeatability(attained: Array) -> float:
    """RP (7.2.2): mean distance of points (n, 3) from their barycentre, and three of its standard deviations."""
    distances = np.linalg.norm(attained - attained.mean(axis=0), axis=1)
    return float(distances.mean() + 3 * distances.std(ddof=1))


def three_sigma(values: Array) -> float:
    """RD (7.3.3) and RPa, b, c (7.2.2): three standard deviations of values (n,)."""
    return float(3 * values.std(ddof=1))


def _criterion(figure: Callable[[Array], Any], rows: Array, unit: Literal["mm", "deg"] = "mm") -> Criterion:
    """A figure of cycles (n, ...) with its standard error by the jackknife (Efron and Stein, 1981)."""
    count = len(rows)
    left = np.array([figure(np.delete(rows, k, axis=0)) for k in range(count)]) if count > 2 else np.array([math.nan])
    return Criterion(float(figure(rows)), float(math.sqrt(count - 1) * left.std()), count, unit)


@dataclass(frozen=True, eq=False)
class _Rows:
    """Measurements (n, 3) or readings (n, 1) in mm with their points, cycles (None: not told), orientations (n, 4)."""

    file: str
    points: list[str]
    cycles: list[str] | None
    lines: tuple[int, ...]
    values: Array
    turns: Array | None
    missing: int

    @staticmethod
    def of(table: Table, known: Sequence[str]) -> _Rows:
        """Rows of a table, without those that were left empty."""
        if "tip_x_mm" in table.header:
            fix = "Name a tracker's or dial's rows"
            raise SamplesError(table.file, "these are targets, not what was measured", fix)
        dial = any(re.fullmatch(r"reading(_\w+)?", name) for name in table.header) and "x_mm" not in table.header
        wanted = ("reading",) if dial else COORDINATES
        found = _lengths(table, wanted)
        index = [table.header.index(column) for column, _ in found.values()]
        if "point" in table.header:
            points = [cell.upper() for cell in table.column("point")]
        else:
            if len(table.rows) % len(CYCLE):
                what = f"there is no column 'point', and {counted(len(table.rows))} are no whole cycles P5 to P1"
                raise SamplesError(table.file, what, "Add the column 'point'")
            points = [*CYCLE] * (len(table.rows) // len(CYCLE))
        here = [k for k, row in enumerate(table.rows) if any(row[i] for i in index)]
        if not here:
            raise SamplesError(table.file, "every line is empty", "Fill in what was measured")
        for k in here:
            if points[k] not in known and not (points[k] == "L" and "L1" in known):
                fix = f"Name one of {', '.join(known[:8])}" + (", ..." if len(known) > 8 else "")
                raise SamplesError(table.file, f"'{points[k]}' is no commanded point", fix, line=table.lines[k])
        cycles = table.column("cycle") if "cycle" in table.header else _in_order(points, known)
        lost = len(table.rows) - len(here)
        table = replace(table, rows=tuple(table.rows[k] for k in here), lines=tuple(table.lines[k] for k in here))
        values = np.column_stack([np.array(table.numbers(column)) * factor for column, factor in found.values()])
        turned = set(QUATERNION) <= set(table.header)
        turns = np.column_stack([table.numbers(name) for name in QUATERNION]) if turned else None
        if turns is not None and (np.abs(np.linalg.norm(turns, axis=1) - 1) > 1e-3).any():
            raise SamplesError(table.file, "a quaternion is not of unit length", "Give unit quaternions qw,qx,qy,qz")
        points, cycles = [points[k] for k in here], None if cycles is None else [cycles[k] for k in here]
        return _Rows(table.file, points, cycles, table.lines, values, turns, lost)

    def of_point(self, name: str) -> dict[str, int]:
        """The row of each cycle in which a point was measured; raises SamplesError where there are two."""
        found = dict[str, int]()
        for k, point in enumerate(self.points):
            if point == name:
                cycle = str(k) if self.cycles is None else self.cycles[k]
                if cycle in found:
                    what = f"{name} was measured in cycle '{cycle}' before"
                    raise SamplesError(self.file, what, "Number the cycles anew", line=self.lines[k])
                found[cycle] = k
        return found

    def paths(self) -> list[list[int]]:
        """Rows of each cycle of the path."""
        rows = [k for k, point in enumerate(self.points) if OF_PATH.fullmatch(point)]
        cycles = [] if self.cycles is None else [self.cycles[k] for k in rows]
        return [[k for k, own in zip(rows, cycles, strict=True) if own == cycle] for cycle in dict.fromkeys(cycles)]


def _in_order(points: Sequence[str], known: Sequence[str]) -> list[str] | None:
    """Cycles of rows that name none: a new one begins where the order does; None where most would have one row."""
    rank = {name: k for k, name in enumerate([*CYCLE, *(each for each in known if each not in CYCLE)])}
    ranks, cycles, cycle = [rank.get(point, -1) for point in points], list[str](), 0
    for k, own in enumerate(ranks):
        cycle += k > 0 and own <= ranks[k - 1]
        cycles.append(str(cycle))
    return cycles if 2 * len(set(cycles)) <= len(points) else None


def _table(measured: Any) -> Table:
    if isinstance(measured, (str, Path)):
        return read_any_table(measured)
    if is_frame(measured):
        return table_of_frame(measured.astype(object).where(measured.notna(), ""))
    raise CasacalError(f"Got {came(measured)} as what was measured", "Give a file or a pandas DataFrame")


def _lengths(table: Table, names: Sequence[str]) -> Mapping[str, tuple[str, float]]:
    """The column of each length and its factor to mm, beside any columns of joints."""
    rest = tuple(name for name in table.header if not re.fullmatch(r"q\d+_\w+", name))
    return match_columns(replace(table.columns, header=rest), Layout((), dict.fromkeys(names, "length")))


def _commanded(targets: Any) -> tuple[dict[str, Array], dict[str, Array]]:
    """Commanded points (3,; mm) by name, and orientations (4,; x, y, z, w) of those that have one."""
    if isinstance(targets, CubePlan):
        wxyz = quaternions_of(targets.poses[:, :3, :3])
        turned = np.roll(wxyz, -1, axis=1)
        return dict(zip(targets.names, targets.tips, strict=True)), dict(zip(targets.names, turned, strict=True))
    if isinstance(targets, Mapping):
        points = {str(name).upper(): np.asarray(place, dtype=np.float64) for name, place in targets.items()}
        if not points or any(place.shape != (3,) or not np.isfinite(place).all() for place in points.values()):
            raise CasacalError("The commanded points are not three numbers each", "Give {'P1': (x, y, z), ...} in mm")
        return points, {}
    if not isinstance(targets, (str, Path)):
        raise CasacalError(f"Got {came(targets)} as targets", "Give a plan, its file, or points by name")
    table = read_any_table(targets)
    tips = "tip_x_mm" in table.header
    if "point" not in table.header or {"qw", "cycle"} & set(table.header):
        what = "these are not the targets of casacal iso9283 PROBLEM, with point and tip_x_mm, tip_y_mm, tip_z_mm"
        raise SamplesError(str(targets), what, "Name the plan, or a CSV of points: point,x_mm,y_mm,z_mm")
    found = _lengths(table, [f"tip_{axis}" if tips else axis for axis in COORDINATES])
    places = np.column_stack([np.array(table.numbers(column)) * factor for column, factor in found.values()])
    labels = [cell.upper() for cell in table.column("point")]
    for k, label in enumerate(labels):
        if label in labels[:k]:
            raise SamplesError(table.file, f"'{label}' is listed twice", "List each point once", line=table.lines[k])
    wxyz = np.column_stack([table.numbers(name) for name in FLANGE]) if tips else np.zeros((0, 4))
    return dict(zip(labels, places, strict=True)), dict(zip(labels, np.roll(wxyz, -1, axis=1), strict=False))


def _frame(
    rows: _Rows, commanded: Mapping[str, Array], kept: Mapping[str, dict[str, int]], in_base: bool, notes: list[str]
) -> tuple[Array | None, Literal["base", "fitted", "none"]]:
    """Transform (4, 4) from the rows' frame to the base; None where nothing fixes one."""
    means = np.array([rows.values[list(each.values())].mean(axis=0) for each in kept.values()]).reshape(-1, 3)
    meant = np.array([commanded[name] for name in kept]).reshape(-1, 3)
    pairs = product(commanded.values(), repeat=2)
    size = max((float(np.linalg.norm(one - two)) for one, two in pairs), default=0)
    for unit, factor in UNITS.items() if len(means) > 1 else ():
        ratio = np.linalg.norm(means - means.mean(axis=0)) / np.linalg.norm(meant - meant.mean(axis=0)) / factor
        if 1 / LIKE < ratio < LIKE:
            fix = f"End the columns in _{unit}" if unit != "m" else "Multiply them by 1000"
            raise SamplesError(rows.file, f"the coordinates seem to be in {unit}, and are read in mm", fix)
    fitted = rigid_fit(means, meant) if len(means) > 2 else None
    frame = np.eye(4) if in_base else fitted
    for transform in (fitted, frame):
        if transform is None:
            continue
        off = np.array([
            np.linalg.norm(transform[:3, :3] @ value + transform[:3, 3] - commanded[point]) if point in commanded else 0
            for point, value in zip(rows.points, rows.values, strict=True)
        ])  # fmt: skip
        worst = int(np.argmax(off))
        if off[worst] > GROSS * size and transform is frame and in_base and fitted is not None:
            what = f"the rows have the shape of the commanded points and lie {off.mean():.0f} mm from them"
            raise SamplesError(rows.file, f"{what}: they are not in the base frame", "Leave out --in-base (in_base)")
        if off[worst] > GROSS * size:
            what = f"{rows.points[worst]} lies {off[worst]:.0f} mm from where it would be in this cube"
            fix = "Look for another cube, points under other names or in another order, or a row that is wrong"
            raise SamplesError(rows.file, what, fix, line=rows.lines[worst])
    if in_base:
        return frame, "base"
    if frame is None:
        notes.append("Fewer than three points fix no frame, so AP and AT cannot be told; with coordinates in the base "
                     "frame, --in-base")  # fmt: skip
        return None, "none"
    notes.append(
        f"The rows were fitted to the {len(means)} commanded points, so AP and AT leave out what a shift and a turn of "
        f"all of them absorb, 6 of {3 * len(means)} coordinates, and are smaller than in the base frame (--in-base); "
        "RP, AD and RD need no frame"
    )
    return frame, "fitted"


def _fitted_accuracy(
    rows: _Rows, commanded: Mapping[str, Array], kept: Mapping[str, Mapping[str, int]], name: str
) -> dict[str, Criterion]:
    """AP of a point where the frame is fitted; its standard error by leaving out one cycle of all points at a time."""

    def off(without: str | None) -> Array:
        left = {point: [k for cycle, k in each.items() if cycle != without] for point, each in kept.items()}
        means = np.array([rows.values[index].mean(axis=0) for index in left.values()])
        if (frame := rigid_fit(means, np.array([commanded[point] for point in left]))) is None:
            return np.full(4, np.nan)
        away = frame[:3, :3] @ means[[*left].index(name)] + frame[:3, 3] - commanded[name]
        return np.append(away, np.linalg.norm(away))

    cycles = list(dict.fromkeys(cycle for each in kept.values() for cycle in each))
    left = np.array([off(cycle) for cycle in cycles]) if len(cycles) > 2 else np.full((1, 4), np.nan)
    whole, std, count = off(None), math.sqrt(len(cycles) - 1) * left.std(axis=0), len(kept[name])
    names = (*(f"AP{axis} {name}" for axis in "xyz"), f"AP {name}")
    found = zip(names, whole.tolist(), std.tolist(), strict=True)
    made = {each: Criterion(value, error, count, "mm") for each, value, error in found}
    return {names[3]: made.pop(names[3]), **made}


def _orientations(
    rows: _Rows, kept: Mapping[str, dict[str, int]], turn: Array, meant: Mapping[str, Array], notes: list[str]
) -> dict[str, Criterion]:
    """RPa, b, c about x, y, z of the base, and APa, b, c where the commanded orientations are known (7.2)."""
    from scipy.spatial.transform import Rotation

    criteria = dict[str, Criterion]()
    for name, each in kept.items():
        assert rows.turns is not None
        seen = Rotation.from_matrix(turn) * Rotation.from_quat(rows.turns[list(each.values())])
        off = np.degrees((seen * seen.mean().inv()).as_rotvec())
        criteria |= {f"RP{'abc'[k]} {name}": _criterion(three_sigma, off[:, k], "deg") for k in range(3)}
        if name in meant:
            off = (seen * Rotation.from_quat(meant[name]).inv()).as_rotvec()
            if np.linalg.norm(off.mean(axis=0)) > TILTED:
                notes.append(f"{name}: the body's axes are not the flange's, so APa, APb and APc cannot be told")
                continue
            criteria |= {f"AP{'abc'[k]} {name}": _criterion(np.mean, np.degrees(off[:, k]), "deg") for k in range(3)}
    return criteria


def _distance(
    rows: _Rows, commanded: Mapping[str, Array], kept: Mapping[str, dict[str, int]], notes: list[str]
) -> dict[str, Criterion]:
    """AD and RD (7.3) between P2 and P4, of cycles in which both were measured."""
    one, two = kept.get("P2", {}), kept.get("P4", {})
    both, why = [cycle for cycle in one if cycle in two], "P2 and P4 were not both measured in two cycles"
    if len(both) < 2:
        why = "nothing tells which rows are of one cycle (add a column 'cycle')" if rows.cycles is None else why
        notes.append(f"AD and RD cannot be told: {why}")
        return {}
    ends = [rows.values[[each[cycle] for cycle in both]] for each in (one, two)]
    meant = np.linalg.norm(commanded["P2"] - commanded["P4"])
    off = np.linalg.norm(ends[0] - ends[1], axis=1) - meant
    if (worst := np.abs(off).max()) > GROSS * meant:
        what = f"P2 and P4 are {worst:.0f} mm off the {meant:.0f} mm that they would be apart in this cube"
        raise SamplesError(rows.file, what, "Look for another cube, or a row that is wrong")
    return {"AD": _criterion(np.mean, off), "RD": _criterion(three_sigma, off)}


def _path(rows: _Rows, commanded: Mapping[str, Array], frame: Array, notes: list[str]) -> dict[str, Criterion]:
    """AT and RT (8.2, 8.3): where each cycle's path crosses the normal planes of the commanded line."""
    line = np.array([place for name, place in commanded.items() if OF_PATH.fullmatch(name)]).reshape(-1, 3)
    if len(line) < 4 or not any(OF_PATH.fullmatch(point) for point in rows.points):
        return {}
    along = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    planes, found = (line[1:-1] - line[0]) @ along, list[Array]()
    for cycle in (paths := rows.paths()):
        path = rows.values[cycle] @ frame[:3, :3].T + frame[:3, 3] - line[0]
        path = path[np.argsort(path @ along)]
        way = path @ along
        whole = len(way) > 1 and way[0] <= planes[0] and way[-1] >= planes[-1]
        if whole and np.diff(way).max() < 1.5 * np.diff(planes).max():
            found.append(np.column_stack([np.interp(planes, way, path[:, k]) for k in range(3)]) - line[1:-1] + line[0])
    if len(found) < len(paths) or len(found) < 2:
        which = f"{len(found)} of {counted(len(paths), 'path')}"
        notes.append(f"{which} cross all {len(planes)} normal planes without a gap")
    if len(found) < 2:
        notes.append("AT and RT cannot be told: two whole paths are needed, with a column 'cycle'")
        return {}

    def worst(figure: Callable[[Array], float]) -> Callable[[Array], float]:
        return lambda cycles: max(figure(cycles[:, k]) for k in range(len(planes)))

    return {name: _criterion(worst(each), np.array(found)) for name, each in (("AT", accuracy), ("RT", repeatability))}


def _of_dial(rows: _Rows, kept: Mapping[str, dict[str, int]], notes: list[str]) -> PoseAccuracy:
    """Scatter of readings along the dial's axis: the only thing that a dial tells of these figures."""
    read = {name: rows.values[list(each.values()), 0] for name, each in kept.items()}
    criteria = {f"3s {name}": _criterion(three_sigma, each) for name, each in read.items()}
    notes.append(
        "A dial sees one axis: 3s is three standard deviations of its readings. RP of ISO 9283 is of three axes, 1.2 "
        "times this where all scatter alike; AP, AD, RD, AT and RT cannot be told"
    )
    return PoseAccuracy(FrozenMapping(criteria), "none", rows.missing, tuple(notes), rows.file)
