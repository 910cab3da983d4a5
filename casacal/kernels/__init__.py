"""Numeric kernels from a row's symbolic graph: printed as C where there is a compiler, replayed in blocks elsewhere.

reading, program, operations: the graph as a list of elementary operations. lanes: rows as kernels read them.
native_*: in C, printed by c_source before the files of c/, built by compiler and kept by libraries.
block_*: on CasADi's machine, by replay.
backend: which of both evaluates rows. steps: which takes an estimator's step, and when NumPy does.
columnwise, batch, curvature: any function of many rows, of few, and exact second derivatives, on CasADi's machine.
"""
