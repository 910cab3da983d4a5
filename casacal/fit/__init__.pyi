"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.fit.bound_problem import BoundProblem as BoundProblem
from casacal.fit.controls import null_step as null_step
from casacal.fit.controls import plane_only as plane_only
from casacal.fit.controls import scipy_least_squares as scipy_least_squares
from casacal.fit.ipopt import nlpsol as nlpsol
from casacal.fit.least_squares import Gaussian as Gaussian
from casacal.fit.least_squares import LeastSquares as LeastSquares
from casacal.fit.least_squares import Result as Result
from casacal.fit.least_squares import Status as Status
from casacal.fit.symbolic import SymbolicProblem as SymbolicProblem
