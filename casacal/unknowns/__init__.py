"""Kinds of unknown: what they are nominally, and a smooth map from local coordinates around that."""

from casacal.unknowns.geometry import Direction, Frame, Plane, PlaneValue
from casacal.unknowns.unknown import Parameter, Unknown

__all__ = ["Direction", "Frame", "Parameter", "Plane", "PlaneValue", "Unknown"]
