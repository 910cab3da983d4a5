"""Estimators: plain functions of a `LeastSquares`, each returning a `Result`; one algorithm per file."""

from casacal.estimators.annealing import annealing
from casacal.estimators.ekf import ekf
from casacal.estimators.evolution import evolution
from casacal.estimators.ipopt import ipopt
from casacal.estimators.lm import lm
from casacal.estimators.nominal import nominal
from casacal.estimators.null_step import null_step
from casacal.estimators.plane_only import plane_only
from casacal.estimators.scipy_least_squares import scipy_least_squares
from casacal.estimators.sckf import sckf
from casacal.estimators.sckf_lm import sckf_lm
from casacal.estimators.swarm import swarm

__all__ = [
    "annealing",
    "ekf",
    "evolution",
    "ipopt",
    "lm",
    "nominal",
    "null_step",
    "plane_only",
    "scipy_least_squares",
    "sckf",
    "sckf_lm",
    "swarm",
]
