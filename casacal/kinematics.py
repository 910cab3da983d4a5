"""Earlier name of `casacal.model.kinematics`; it goes with the next version."""

from casacal.public import moved

__getattr__ = moved("casacal.kinematics", "casacal.model.kinematics")
