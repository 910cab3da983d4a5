"""Numeric kernels from a row's symbolic graph: printed as C where there is a compiler, replayed in blocks elsewhere.

program, reading, operations, algebra: the graph as a list of elementary operations. lanes: rows as kernels read them.
native_rows: in C, printed by c_source before the files of c/, built by compiler and kept by libraries.
block_rows: on CasADi's machine. filter_passes: the filters, in C or there.
backend: which of both evaluates rows, and which takes an estimator's step.
batch, curvature: any function of many rows, of few, and exact second derivatives, on CasADi's machine.
"""
