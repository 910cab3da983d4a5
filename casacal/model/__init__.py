"""The symbolic model: kinematics, unknowns, robots, instruments, and the problem that joins them."""

from casacal.public import homes, on_demand

_HOMES = homes(__name__)
__getattr__ = on_demand(__name__, _HOMES)
__all__ = sorted(_HOMES)
