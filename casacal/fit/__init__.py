"""Fitting: the seam f(x), problems bound to samples, estimators, and the IPOPT reference."""
