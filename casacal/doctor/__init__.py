"""The convention doctor: what a controller's joint values and poses mean to a model, from rows of its pendant.

The data doctor, `casacal check`, looks at samples instead.
"""

from casacal.public import homes, on_demand

_HOMES = homes(__name__)
__getattr__ = on_demand(__name__, _HOMES)
__all__ = sorted(_HOMES)
