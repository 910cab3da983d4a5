"""The data doctor: what is wrong with samples, in words, before anyone trusts a fit."""

from casacal.doctor.check import check
from casacal.doctor.finding import Finding

__all__ = ["Finding", "check"]
