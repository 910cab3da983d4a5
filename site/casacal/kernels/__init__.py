"""Numeric kernels from a row's symbolic graph: printed as C where there is a compiler, replayed in blocks elsewhere.

algebra, program: the graph as a list of elementary operations. rows: what every back end does with rows.
native_rows: in C, printed by c_source before the files of c/, built by compiler and kept by libraries.
batch, block_rows: on CasADi's machine, also any function of many rows and exact second derivatives.
filter_passes: the cubature filter, in C or there. backend: which of both evaluates rows.
"""
