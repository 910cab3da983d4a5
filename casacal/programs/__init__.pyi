"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.programs.correct import CorrectedProgram as CorrectedProgram
from casacal.programs.correct import compensate_program as compensate_program
from casacal.programs.correct import predict_program as predict_program
from casacal.programs.program import TaughtProgram as TaughtProgram
from casacal.programs.read import read_program as read_program
