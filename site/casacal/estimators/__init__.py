"""Estimators: plain functions of a `LeastSquares`, each returning a `Result`; one algorithm a file where it is long."""

from casacal.estimators.controls import null_step, plane_only
from casacal.estimators.ekf import ekf
from casacal.estimators.ipopt import ipopt, nlpsol
from casacal.estimators.lm import lm
from casacal.estimators.nominal import nominal
from casacal.estimators.population import annealing, evolution, swarm
from casacal.estimators.scipy_least_squares import scipy_least_squares
from casacal.estimators.sckf import sckf
from casacal.estimators.sckf_lm import sckf_lm

__all__ = [
    "annealing",
    "ekf",
    "evolution",
    "ipopt",
    "lm",
    "nlpsol",
    "nominal",
    "null_step",
    "plane_only",
    "scipy_least_squares",
    "sckf",
    "sckf_lm",
    "swarm",
]
