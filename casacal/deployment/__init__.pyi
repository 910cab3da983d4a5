"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.deployment.arm import CalibratedArm as CalibratedArm
from casacal.deployment.compensate import Compensation as Compensation
from casacal.deployment.compensate import Outcome as Outcome
from casacal.deployment.compensate import Targets as Targets
from casacal.deployment.compensate import read_targets as read_targets
from casacal.deployment.predict import Prediction as Prediction
from casacal.deployment.result_file import read_result as read_result
