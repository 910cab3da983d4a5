"""Estimators: plain functions of a `LeastSquares`; one algorithm a file where it is long.

Population methods and SciPy's are imported from their own modules, `population` and `scipy_least_squares`.

Each returns a `Result`: x (n,), deviations from nominal in the units of `problem.units`, with its covariance (n, n).
"""

from casacal.estimators.controls import null_step as null_step
from casacal.estimators.controls import plane_only as plane_only
from casacal.estimators.ekf import ekf as ekf
from casacal.estimators.ipopt import ipopt as ipopt
from casacal.estimators.ipopt import nlpsol as nlpsol
from casacal.estimators.lm import lm as lm
from casacal.estimators.sckf import sckf as sckf
from casacal.estimators.sckf_lm import sckf_lm as sckf_lm
from casacal.least_squares.result import nominal as nominal
