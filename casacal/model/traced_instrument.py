"""An instrument as a graph: what a result keeps of one, so that it is read without the file that declared it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca

from casacal.model.geometry import Plane, packed_symbols
from casacal.model.instrument import Instrument, Sight
from casacal.model.kinematics import Expression, Product
from casacal.model.unknown import Unknown
from casacal.values import Array, FrozenMapping, Names, frozen


def _declared(name: str) -> Any:
    """A property as it was declared; in files from before it was kept, as instruments have it by default."""
    return property(lambda self: self.declared[name] if name in self.declared else getattr(Instrument, name).fget(self))


@dataclass(frozen=True, eq=False)
class TracedInstrument(Instrument):
    """Declarations of an instrument, and its functions as a graph.

    declared: its properties of `DECLARED`, by name, and instances, by the key of the unknown: of labels that share it
    with another one, such as steps, with which. values: unknowns of the robot and its own, by key, in the order of
    the graph's arguments. graph: flange pose (4x4, mm), packed values and columns to residual, tip (3, mm) and plunger.
    """

    declared: Mapping[str, Any]
    values: Mapping[str, Unknown]
    graph: ca.Function

    columns = _declared("columns")
    unknowns = _declared("unknowns")
    known_columns = _declared("known_columns")
    known_by = _declared("known_by")
    knows_every_label = _declared("knows_every_label")
    datum = _declared("datum")
    column_stds = _declared("column_stds")
    residual_std = _declared("residual_std")
    probe = _declared("probe")
    blocks = _declared("blocks")
    trusted = _declared("trusted")
    words = _declared("words")
    groups = _declared("groups")

    @staticmethod
    def of(instrument: Instrument, parameters: Mapping[str, Unknown]) -> TracedInstrument:
        """Trace an instrument on a robot with these parameters; lets pass what its functions raise."""
        every = {**parameters, **instrument.unknowns}
        symbols, values = packed_symbols(every)
        pose, p = ca.SX.sym("pose", 4, 4), Names(**values)
        columns = {name: ca.SX.sym(name) for name in (*instrument.columns, *instrument.known_columns)}
        row = Names(**columns)
        plunger = instrument.plunger_direction(pose, p)
        written = instrument.residual(pose, p, row), instrument.tip(pose, p, row)
        built = (*written, ca.SX(0, 1) if plunger is None else plunger)
        graph = ca.Function("instrument", [pose, *symbols, *columns.values()], [ca.densify(ca.SX(e)) for e in built])
        declared = {name: getattr(instrument, name) for name in DECLARED}
        known = {label for labels in instrument.known_columns.values() for label in labels}
        by_label = [key for key, unknown in instrument.unknowns.items() if unknown.per is not None]
        shared = {key: {label: instrument.instance(key, label) for label in sorted(known)} for key in by_label}
        if shared := {key: names for key, names in shared.items() if any(a != b for a, b in names.items())}:
            declared["instances"] = shared
        return TracedInstrument(frozen(declared), FrozenMapping(every), graph)

    def instance(self, key: str, label: str) -> str:
        """The label's own instance of an unknown, or the one that it shared when it was traced."""
        shared = self.declared.get("instances", {})
        return str(shared.get(key, shared.get("plane", {}) if key not in self.unknowns else {}).get(label, label))

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
        heights = sight.columns["height"] if "height" in self.known_columns else None
        return sight.touched_plane(heights) if isinstance(self.unknowns[key], Plane) else super().propose(key, sight)

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
"""Names of the properties that an instrument declares."""
