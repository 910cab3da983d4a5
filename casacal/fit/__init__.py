"""Fitting: the seam f(x), problems bound to samples, estimators, and the IPOPT reference."""

from casacal.public import homes, on_demand

_HOMES = homes(__name__)
__getattr__ = on_demand(__name__, _HOMES)
__all__ = sorted(_HOMES)
