"""Numeric kernels from a row's symbolic graph: printed as C where there is a compiler, replayed in blocks elsewhere.

program: the graph as a list of elementary operations, each in its cheapest form. rows: what every back end does with
rows. block_rows: on CasADi's machine, also any function of many rows and exact second derivatives. native_rows: in C,
printed before the files of c/, or else there; libraries: built and kept. filter_passes: the cubature filter, in both.
"""

from casacal.public import homes, on_demand

_HOMES = homes(__name__)
__getattr__ = on_demand(__name__, _HOMES)
__all__ = sorted(_HOMES)
