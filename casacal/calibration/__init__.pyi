"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.calibration.calibrate import calibration_of as calibration_of
from casacal.calibration.calibrated import Calibrated as Calibrated
from casacal.calibration.calibration import Calibration as Calibration
from casacal.calibration.finding import Finding as Finding
from casacal.calibration.motion import Tried as Tried
from casacal.calibration.saved import SavedCalibration as SavedCalibration
