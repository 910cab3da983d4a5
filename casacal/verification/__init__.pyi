"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.verification.cube import CubePlan as CubePlan
from casacal.verification.cube import plan_cube as plan_cube
from casacal.verification.performance import Criterion as Criterion
from casacal.verification.performance import PoseAccuracy as PoseAccuracy
from casacal.verification.performance import pose_accuracy as pose_accuracy
from casacal.verification.verification import Verification as Verification
