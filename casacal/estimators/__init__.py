"""Estimators: plain functions of a `LeastSquares`, each returning a `Result`; one algorithm a file."""

from casacal.estimators.annealing import annealing
from casacal.estimators.ekf import ekf
from casacal.estimators.evolution import evolution
from casacal.estimators.ipopt import ipopt
from casacal.estimators.lm import lm
from casacal.estimators.plane_only import plane_only
from casacal.estimators.sckf import sckf
from casacal.estimators.sckf_lm import sckf_lm
from casacal.estimators.swarm import swarm

__all__ = ["annealing", "ekf", "evolution", "ipopt", "lm", "plane_only", "sckf", "sckf_lm", "swarm"]
