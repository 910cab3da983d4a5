"""Non-geometric effects of arm and cell, each with a size to expect and written in a few symbolic lines.

Each says its `size`, and by `doubt` the times by which that may well be more (see `effect.Effect`).
"""

from casacal.effects.compliance import GravitySag as GravitySag
from casacal.effects.compliance import LinkSag as LinkSag
from casacal.effects.compliance import TorqueCompliance as TorqueCompliance
from casacal.effects.effect import Effect as Effect
from casacal.effects.effect import weighted as weighted
from casacal.effects.gears import Backlash as Backlash
from casacal.effects.gears import GearRipple as GearRipple
from casacal.effects.gears import JointCoupling as JointCoupling
from casacal.effects.gears import TransmissionError as TransmissionError
from casacal.effects.kit import kit as kit
from casacal.effects.kit import rich_kit as rich_kit
from casacal.effects.kit import with_kit as with_kit
from casacal.effects.kit import with_link_kit as with_link_kit
from casacal.effects.kit import with_rich_kit as with_rich_kit
from casacal.effects.smooth import Drift as Drift
from casacal.effects.smooth import FaceForm as FaceForm
from casacal.effects.smooth import JointField as JointField
from casacal.effects.smooth import PlateForm as PlateForm
from casacal.effects.smooth import SphereForm as SphereForm
from casacal.effects.smooth import ThermalGrowth as ThermalGrowth
from casacal.effects.trusted import FocalLength as FocalLength

# names of earlier versions
GearWaves, GravityGive, LinkGive, MeasuredGive = TransmissionError, GravitySag, LinkSag, TorqueCompliance
