"""Planning: the touches that tell most of where the tip will be wanted, their route, and advice after a fit."""

from casacal.public import homes, on_demand

_HOMES = homes(__name__)
__getattr__ = on_demand(__name__, _HOMES)
__all__ = sorted(_HOMES)
