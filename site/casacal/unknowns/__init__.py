"""Kinds of unknown: what they are nominally, and a smooth map from local coordinates around that."""

from casacal.unknowns.direction import Direction
from casacal.unknowns.frame import Frame
from casacal.unknowns.parameter import Parameter
from casacal.unknowns.plane import Plane, PlaneValue
from casacal.unknowns.unknown import Unknown

__all__ = ["Direction", "Frame", "Parameter", "Plane", "PlaneValue", "Unknown"]
