"""Measuring at the machine: touches taken one by one, each judged as it is made, and gauges."""

from casacal.public import homes, on_demand

_HOMES = homes(__name__)
__getattr__ = on_demand(__name__, _HOMES)
__all__ = sorted(_HOMES)
