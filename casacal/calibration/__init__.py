"""Calibration: check, fit, verdict, typed result and report."""
