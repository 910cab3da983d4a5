"""The convention doctor: what a controller's joint values and poses mean to a model, from rows of its pendant.

The data doctor, `casacal.doctor`, looks at samples instead.
"""

from casacal.convention_doctor.diagnosis import Diagnosis, diagnose
from casacal.convention_doctor.pendant_rows import PendantRows, read_pendant_rows

__all__ = ["Diagnosis", "PendantRows", "diagnose", "read_pendant_rows"]
