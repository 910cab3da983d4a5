"""Compensation: where a calibrated robot is, and joint targets at which it goes where it should."""
