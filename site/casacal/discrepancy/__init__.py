"""What an arm and a cell do beside their geometry: small effects of a size to expect, each in a few symbolic lines."""

from casacal.discrepancy.arm import GravitySag, ThermalGrowth
from casacal.discrepancy.compliance import LinkSag, TorqueCompliance
from casacal.discrepancy.effect import Effect, weighted
from casacal.discrepancy.gears import Backlash, GearRipple, TransmissionError
from casacal.discrepancy.kit import kit, rich_kit
from casacal.discrepancy.smooth import Drift, FaceForm, JointField

# names of earlier versions
GearWaves, GravityGive, LinkGive, MeasuredGive = TransmissionError, GravitySag, LinkSag, TorqueCompliance

__all__ = [
    "Backlash",
    "Drift",
    "Effect",
    "FaceForm",
    "GearRipple",
    "GravitySag",
    "JointField",
    "LinkSag",
    "ThermalGrowth",
    "TorqueCompliance",
    "TransmissionError",
    "kit",
    "rich_kit",
    "weighted",
]
