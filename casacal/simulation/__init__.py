"""Simulation: an arm drawn from its prior touches the faces of a cell."""

from casacal.public import homes, on_demand

_HOMES = homes(__name__)
__getattr__ = on_demand(__name__, _HOMES)
__all__ = sorted(_HOMES)
