"""Instruments: how rows are measured. Those without a dial are imported when they are asked for."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from casacal.instruments.description import Probe as Probe
from casacal.instruments.description import ResidualBlock as ResidualBlock
from casacal.instruments.description import Sight as Sight
from casacal.instruments.description import Suspect as Suspect
from casacal.instruments.description import Words as Words
from casacal.instruments.dial import DialOnBody as DialOnBody
from casacal.instruments.dial import DialOnPlane as DialOnPlane
from casacal.instruments.dial import Step as Step
from casacal.instruments.dial import dial_cycle as dial_cycle
from casacal.instruments.dial import dial_gain as dial_gain
from casacal.instruments.dial import dial_zero as dial_zero
from casacal.instruments.instrument import Instrument as Instrument
from casacal.instruments.instrument import tool_point as tool_point

if TYPE_CHECKING:
    from casacal.instruments.points import Distance as Distance
    from casacal.instruments.points import FixedPoint as FixedPoint
    from casacal.instruments.points import KnownPoint as KnownPoint
    from casacal.instruments.points import SelfContact as SelfContact
    from casacal.instruments.points import Sockets as Sockets
    from casacal.instruments.points import SphereTouch as SphereTouch
    from casacal.instruments.points import TrackedPoint as TrackedPoint
    from casacal.instruments.tracked_pose import TrackedPose as TrackedPose


def __getattr__(name: str) -> Any:
    for module in ("points", "tracked_pose"):
        found = import_module(f"casacal.instruments.{module}")
        if name in vars(found):
            return vars(found)[name]
    raise AttributeError(f"casacal.instruments has no '{name}'")
