"""Earlier name of `casacal.effects`; it goes with the next version."""

from casacal.public import moved

__getattr__ = moved("casacal.discrepancy", "casacal.effects")
