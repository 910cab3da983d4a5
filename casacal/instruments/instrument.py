"""A way of measuring: columns, unknowns, a signed smooth residual; the same as a graph; a tip fixed to the flange."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, get_args

import casadi as ca
import numpy as np

from casacal.array_types import Array
from casacal.errors import ProblemError, came, refuse_unknown
from casacal.instruments.description import Dimension, Probe, ResidualBlock, Sight, Suspect, Words, mistakes_in
from casacal.kinematics import Expression, Product, position, transform_point
from casacal.unknowns import Parameter, Plane, Unknown
from casacal.unknowns.geometry import packed_symbols
from casacal.user_code import Portable
from casacal.values import FrozenMapping, frozen, is_real


class NoProposalError(ProblemError):
    """An unknown without a nominal value for which an instrument has no formula."""


class Instrument(Portable, ABC):
    """A way of measuring: the columns it reads, its own unknowns, and a signed smooth residual.

    A subclass gives `residual`, mostly `columns`, `unknowns` and its noise (`residual_std` or `column_stds`), and
    overrides what differs from the defaults below, by a property or by a plain attribute. A subclass that is a frozen
    dataclass has its fields for unknowns, and can have them held or given other priors by `Problem.fix` and
    `Problem.with_prior`.
    """

    @abstractmethod
    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Signed, smooth residual: a scalar or a column (m, 1), in the unit of its noise.

        Args:
            pose: 4x4 flange pose, mm.
            p: values of the robot's parameters and of this instrument's unknowns, by name.
            row: values of `columns`, by name.

        """

    @property
    def columns(self) -> Mapping[str, Dimension]:
        """Columns it reads from a row, beside the joints: name to dimension."""
        return {}

    @property
    def refused_columns(self) -> Mapping[str, str]:
        """Columns that contradict the declaration: name to the sentence that says why."""
        return {}

    @property
    def unknowns(self) -> Mapping[str, Unknown]:
        """Its own unknowns: planes, tool, zero; by default the fields of a dataclass that are unknowns, in order."""
        return {key: value for key, value in _fields(self).items() if isinstance(value, Unknown)}

    @property
    def datum(self) -> tuple[str, ...]:
        """Keys of the unknowns that only say where the touched or watching thing stands; the control M0 fits these.

        By default the unknowns whose prior is flat: nobody knew beforehand where such a thing stands.
        """
        return tuple(key for key, u in self.unknowns.items() if u.size and not np.isfinite(u.prior_stds).any())

    @property
    def column_stds(self) -> Mapping[str, float]:
        """Standard deviation of the error of each column, in mm, rad or the user's unit."""
        return {}

    @property
    def residual_std(self) -> float:
        """Standard deviation of what the residual sees beside errors of columns and joints, in its unit."""
        return 0.0

    @property
    def blocks(self) -> tuple[ResidualBlock, ...]:
        """Parts of the residual that differ in unit or noise, in order; none where `residual_std` says it all."""
        return ()

    @property
    def ranges(self) -> tuple[str, ...]:
        """Fields that may be two numbers, the smallest and the largest."""
        return ()

    @property
    def begins_at(self) -> Mapping[str, float]:
        """Readings from which simulated ones are looked for, where zero is none."""
        return {}

    @property
    def reading_limits(self) -> Mapping[str, tuple[float, float]]:
        """Smallest and largest reading of columns that have one, which simulated ones keep to; mm, rad or own unit."""
        return {}

    def as_read(self, columns: Mapping[str, Array]) -> Mapping[str, Array]:
        """Simulated readings (N,) by name as a device would say them: of those that mean the same, one."""
        return columns

    def stands(self, key: str, near: Array, normal: Array) -> Array:
        """Nominal of an unknown that was declared without one where it is simulated, near a place (3, mm)."""
        return self.unknowns[key].placed(near, normal)

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Where the instrument touches or is watched (3, mm); the flange's origin unless overridden."""
        del p, row
        return position(pose)

    def plunger_direction(self, pose: Expression, p: Any) -> Expression | None:
        """Direction (3) of a plunger in the base frame, out of the tool; None for an instrument without one."""
        del pose, p
        return None

    def propose(self, key: str, sight: Sight) -> Array:
        """Nominal of an unknown that was declared without one, from what the nominal robot says.

        Raises NoProposalError where the residual is to find it, ProblemError where the rows cannot tell.
        """
        del sight
        raise NoProposalError(
            f"Unknown '{key}' of {type(self).__name__} has no nominal value",
            "Give it one, or override `propose`, which finds it from the samples",
        )

    @property
    def known_columns(self) -> Mapping[str, Mapping[str, float]]:
        """Columns that follow from the row's `known_by` label instead of being read: name to label to value, else 0."""
        return {}

    @property
    def known_by(self) -> str:
        """The label column that `known_columns` follow from."""
        return "plane"

    @property
    def knows_every_label(self) -> bool:
        """Whether a label that `known_columns` do not list is a mistake; by default it stands for zero."""
        return False

    def instance(self, key: str, label: str) -> str:
        """Which instance of an unknown a label shares; its own unless overridden."""
        del key
        return label

    @property
    def groups(self) -> str | None:
        """The label column by which rows are drawn and listed; by default the first that its unknowns differ by."""
        return next((unknown.per for unknown in self.unknowns.values() if unknown.per is not None), None)

    @property
    def words(self) -> Words:
        """How reports call what it measures."""
        return Words(before=f"{' and '.join(self.datum)} fitted alone" if self.datum else "nothing fitted")

    @property
    def probe(self) -> Probe | None:
        """The probe that touches flat faces; None for other instruments."""
        return None

    @property
    def suspects(self) -> tuple[Suspect, ...]:
        """Mistakes in its columns that `check` undoes one by one to see whether all fits then: signs, units, swaps."""
        return mistakes_in(self.columns)

    def with_faces_by_label(self) -> Instrument | None:
        """A copy with a face of its own for each label, for `cures` that add one; None where that has no meaning."""
        return None

    def with_step(self, label: str, on: str, height: float) -> Instrument | None:
        """A copy with a face at a known height (mm) on another one; None where that has no meaning."""
        del label, on, height
        return None


def check_declaration(instrument: object) -> None:
    """Raise ProblemError for what is no instrument, or says of itself what cannot be."""
    if isinstance(instrument, type) and issubclass(instrument, Instrument):
        what = f"Got the class {instrument.__name__}, not an instrument"
        raise ProblemError(what, f"Make one: {instrument.__name__}(...)")
    if not isinstance(instrument, Instrument):
        fix = "Give instruments one by one, such as DialOnPlane"
        raise ProblemError(f"Got {came(instrument)} as an instrument", fix)
    name = type(instrument).__name__
    for what in ("columns", "column_stds", "reading_limits", "begins_at", "known_columns", "unknowns"):
        if not isinstance(getattr(instrument, what), Mapping):
            raise ProblemError(f"{what} of {name} is {came(getattr(instrument, what))}", "Make it a dict by name")
    for column, dimension in instrument.columns.items():
        if dimension not in get_args(Dimension):
            fix = f"Known: {', '.join(get_args(Dimension))}"
            raise ProblemError(f"Column '{column}' of {name} is a '{dimension}'", fix)
    for what in ("column_stds", "reading_limits", "begins_at"):
        for column in getattr(instrument, what):
            if column not in instrument.columns:
                known = ", ".join(instrument.columns) or "none"
                raise ProblemError(f"{what} of {name} names '{column}', which is no column", f"Its columns: {known}")
    for key, unknown in instrument.unknowns.items():
        if not isinstance(unknown, Unknown):
            raise ProblemError(f"Unknown '{key}' of {name} is {came(unknown)}", "Make it a Parameter or its like")


def with_unknown(instrument: Instrument, key: str, unknown: Unknown) -> Instrument:
    """The instrument with another unknown: a field of a dataclass, or an entry of a plain `unknowns`."""
    if key in _fields(instrument):
        return dataclasses.replace(instrument, **{key: unknown})  # type: ignore[type-var]
    if isinstance(getattr(type(instrument), "unknowns", None), property):
        what = f"'{key}' of {type(instrument).__name__} cannot be replaced"
        raise ProblemError(what, "Make the instrument a dataclass with that field")
    changed: Instrument = object.__new__(type(instrument))
    for name, item in {**vars(instrument), "unknowns": {**instrument.unknowns, key: unknown}}.items():
        object.__setattr__(changed, name, item)
    return changed


def with_setting(instrument: Instrument, name: str, value: float | tuple[float, float]) -> Instrument:
    """The instrument with another number, such as its sign or its noise_std, or pair of them, such as its travel.

    Raises UnknownNameError for what is none of its numbers, ProblemError where the instrument refuses the value.
    """
    present = _fields(instrument)
    numbers = [key for key, held in present.items() if isinstance(held, (int, float)) and not isinstance(held, bool)]
    refuse_unknown(f"number of {type(instrument).__name__}", [name], [*numbers, *instrument.ranges])
    if isinstance(value, tuple):
        if name not in instrument.ranges:
            raise ProblemError(f"{name} of {type(instrument).__name__} is one number, not {value}", "Give one")
    else:
        value = int(value) if isinstance(present[name], int) and float(value).is_integer() else float(value)
    return dataclasses.replace(instrument, **{name: value})  # type: ignore[type-var]


def _fields(instrument: Instrument) -> dict[str, object]:
    """The fields of a dataclass by name; none of another class."""
    if not dataclasses.is_dataclass(instrument):
        return {}
    return {each.name: getattr(instrument, each.name) for each in dataclasses.fields(instrument)}


def tool_point(
    x: float = 0.0, y: float = 0.0, z: float = 0.0, *, prior_std: float = math.inf, free: bool = True
) -> Parameter:
    """Tool point (3, mm) in the flange frame, with components tool_x, tool_y, tool_z; its prior is flat by default."""
    return Parameter((x, y, z), unit="mm", prior_std=prior_std, free=free, labels=("_x", "_y", "_z"))


@dataclass(frozen=True, kw_only=True)
class ToolTip(Instrument):
    """Base of instruments that observe one point of the flange, `tool` (mm).

    noise_std: standard deviation of each residual, mm; raises ProblemError for one that is not positive.
    """

    noise_std: float
    tool: Parameter = tool_point()

    def __post_init__(self) -> None:
        if not is_real(self.noise_std) or not 0 < self.noise_std < math.inf:
            what = f"noise_std of {type(self).__name__} is {self.noise_std!r}"
            raise ProblemError(what, "Give a positive number of mm")

    @property
    def residual_std(self) -> float:
        """Noise of each residual, mm."""
        return self.noise_std

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """Return the point in the base frame (3, mm)."""
        del row
        return transform_point(pose, p.tool)


def proposed_point(per: str) -> Parameter:
    """A point (3, mm) in the base frame for each value of a label column, which the rows propose; its prior is flat."""
    return Parameter(None, unit="mm", labels=("_x", "_y", "_z"), per=per)


def centre_of(points: Array, distances: Array, *, zero: bool = False) -> Array:
    """Point (3, mm) from which points (N, 3) lie at distances (N,), or at these but for one number if `zero`.

    |p|^2 - 2 p'c + |c|^2 = d^2 is linear in c and |c|^2; a common zero adds 2 d. Where the points leave a direction
    open, as on a plane, c lies in their midst along it.
    """
    middle = points.mean(axis=0)
    p = points - middle
    columns = [-2 * p, np.ones((len(p), 1))] + ([2 * distances[:, None]] if zero else [])
    solved, *_ = np.linalg.lstsq(np.hstack(columns), distances**2 - (p**2).sum(axis=1), rcond=1e-9)
    return np.asarray(middle + solved[:3])


def _declared(name: str, before: Any = None) -> Any:
    """A property as it was declared; in files from before it was, this."""
    return property(lambda self: self.declared.get(name, before))


@dataclass(frozen=True, eq=False)
class TracedInstrument(Instrument):
    """Declarations of an instrument, and its functions as a graph.

    declared: its properties of `DECLARED`, by name. values: unknowns of the robot and its own, by key, in the order of
    the graph's arguments. graph: flange pose (4x4, mm), their packed values, and the row's columns to residual, tip (3,
    mm) and plunger (3, or nothing).
    """

    declared: Mapping[str, Any]
    values: Mapping[str, Unknown]
    graph: ca.Function

    columns = _declared("columns")
    unknowns = _declared("unknowns")
    known_columns = _declared("known_columns")
    known_by = _declared("known_by")
    knows_every_label = _declared("knows_every_label", False)
    datum = _declared("datum")
    column_stds = _declared("column_stds")
    residual_std = _declared("residual_std")
    probe = _declared("probe")
    blocks = _declared("blocks", ())

    @staticmethod
    def of(instrument: Instrument, parameters: Mapping[str, Unknown]) -> TracedInstrument:
        """Trace an instrument on a robot with these parameters; lets pass what its functions raise."""
        every = {**parameters, **instrument.unknowns}
        symbols, values = packed_symbols(every)
        pose, p = ca.SX.sym("pose", 4, 4), SimpleNamespace(**values)
        columns = {name: ca.SX.sym(name) for name in (*instrument.columns, *instrument.known_columns)}
        row = SimpleNamespace(**columns)
        plunger = instrument.plunger_direction(pose, p)
        seen = instrument.residual(pose, p, row), instrument.tip(pose, p, row)
        built = (*seen, ca.SX(0, 1) if plunger is None else plunger)
        graph = ca.Function("instrument", [pose, *symbols, *columns.values()], [ca.densify(ca.SX(e)) for e in built])
        declared = {name: getattr(instrument, name) for name in DECLARED}
        return TracedInstrument(frozen(declared), FrozenMapping(every), graph)

    def residual(self, pose: Expression, p: Any, row: Any) -> Expression:
        """The residual that was traced."""
        return self._called(pose, p, row)[0]

    def tip(self, pose: Expression, p: Any, row: Any) -> Expression:
        """The tip that was traced (3, mm)."""
        return self._called(pose, p, row, whole=False)[1]

    def plunger_direction(self, pose: Expression, p: Any) -> Expression | None:
        """The plunger's direction that was traced (3), or None."""
        return None if self.graph.numel_out(2) == 0 else self._called(pose, p, None, whole=False)[2]

    def propose(self, key: str, sight: Sight) -> Array:
        """A plane through the tips; for anything else the instrument itself would have to be asked."""
        return sight.touched_plane() if isinstance(self.unknowns[key], Plane) else super().propose(key, sight)

    def _called(self, pose: Expression, p: Any, row: Any, *, whole: bool = True) -> list[Expression]:
        """All outputs; of a tip or a plunger alone, unknowns that nobody gives, such as a face, play no part."""
        packed = [
            unknown.packed(getattr(p, key)) if whole or hasattr(p, key) else ca.DM.zeros(*self.graph.size_in(i))
            for i, (key, unknown) in enumerate(self.values.items(), 1)
        ]
        names = (*self.columns, *self.known_columns)
        known = [getattr(row, name, 0.0) for name in names]  # a tip is asked for without a row, at reading zero
        return list(self.graph.call([pose.matrix if isinstance(pose, Product) else pose, *packed, *known]))


DECLARED = tuple(name for name, item in vars(TracedInstrument).items() if isinstance(item, property))
"""What an instrument declares of itself."""
