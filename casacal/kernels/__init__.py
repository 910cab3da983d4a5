"""Numeric kernels from a row's symbolic graph: printed as C where there is a compiler, replayed in blocks elsewhere."""
