"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.doctor.diagnosis import Diagnosis as Diagnosis
from casacal.doctor.pendant_rows import PendantRows as PendantRows
from casacal.doctor.pendant_rows import read_pendant_rows as read_pendant_rows
