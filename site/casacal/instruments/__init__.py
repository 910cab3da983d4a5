"""Instruments: how rows are measured."""

from casacal.instruments.description import Probe as Probe
from casacal.instruments.description import ResidualBlock as ResidualBlock
from casacal.instruments.description import Sight as Sight
from casacal.instruments.description import Suspect as Suspect
from casacal.instruments.description import Words as Words
from casacal.instruments.dial_on_body import DialOnBody as DialOnBody
from casacal.instruments.dial_on_plane import DialOnPlane as DialOnPlane
from casacal.instruments.dial_parts import Step as Step
from casacal.instruments.dial_parts import dial_cycle as dial_cycle
from casacal.instruments.dial_parts import dial_gain as dial_gain
from casacal.instruments.dial_parts import dial_zero as dial_zero
from casacal.instruments.distances import Distance as Distance
from casacal.instruments.distances import SelfContact as SelfContact
from casacal.instruments.distances import SphereTouch as SphereTouch
from casacal.instruments.instrument import Instrument as Instrument
from casacal.instruments.points import FixedPoint as FixedPoint
from casacal.instruments.points import KnownPoint as KnownPoint
from casacal.instruments.points import Sockets as Sockets
from casacal.instruments.points import TrackedPoint as TrackedPoint
from casacal.instruments.tool_tip import tool_point as tool_point
from casacal.instruments.tracked_pose import TrackedPose as TrackedPose
