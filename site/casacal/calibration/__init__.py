"""Calibration: the fit, what it is compared with, and all that is said about it."""
