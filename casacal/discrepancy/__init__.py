"""What an arm and a cell do beside their geometry: small effects of a size to expect, each in a few symbolic lines.

Each says its `size`, and by `doubt` the times by which that may well be more (see `effect.Effect`).
"""

from casacal.discrepancy.compliance import GravitySag as GravitySag
from casacal.discrepancy.compliance import LinkSag as LinkSag
from casacal.discrepancy.compliance import TorqueCompliance as TorqueCompliance
from casacal.discrepancy.effect import Effect as Effect
from casacal.discrepancy.effect import weighted as weighted
from casacal.discrepancy.gears import Backlash as Backlash
from casacal.discrepancy.gears import GearRipple as GearRipple
from casacal.discrepancy.gears import TransmissionError as TransmissionError
from casacal.discrepancy.kit import kit as kit
from casacal.discrepancy.kit import rich_kit as rich_kit
from casacal.discrepancy.kit import with_kit as with_kit
from casacal.discrepancy.kit import with_link_kit as with_link_kit
from casacal.discrepancy.kit import with_rich_kit as with_rich_kit
from casacal.discrepancy.smooth import Drift as Drift
from casacal.discrepancy.smooth import FaceForm as FaceForm
from casacal.discrepancy.smooth import JointField as JointField
from casacal.discrepancy.smooth import ThermalGrowth as ThermalGrowth

# names of earlier versions
GearWaves, GravityGive, LinkGive, MeasuredGive = TransmissionError, GravitySag, LinkSag, TorqueCompliance
