"""Instruments: what a measurement sees of a pose."""

from casacal.instruments.dial_on_body import DialOnBody
from casacal.instruments.dial_on_plane import DialOnPlane, Step, tool_point
from casacal.instruments.instrument import Instrument, Sight
from casacal.instruments.tracked_point import TrackedPoint

__all__ = ["DialOnBody", "DialOnPlane", "Instrument", "Sight", "Step", "TrackedPoint", "tool_point"]
