"""Instruments: what a measurement sees of a pose."""

from casacal.instruments.dial_on_plane import DialOnPlane, tool_point
from casacal.instruments.instrument import Instrument, Sight
from casacal.instruments.tracked_point import TrackedPoint

__all__ = ["DialOnPlane", "Instrument", "Sight", "TrackedPoint", "tool_point"]
