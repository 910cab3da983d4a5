"""The convention doctor: what a controller's joint values and poses mean to a model, from rows of its pendant.

The data doctor, `casacal check`, looks at samples instead.
"""

from casacal.doctor.diagnosis import Diagnosis, diagnose
from casacal.doctor.pendant_rows import PendantRows, read_pendant_rows

__all__ = ["Diagnosis", "PendantRows", "diagnose", "read_pendant_rows"]
