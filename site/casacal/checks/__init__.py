"""The data doctor: what is wrong with samples, in words, before anyone trusts a fit."""

from casacal.checks.check import check
from casacal.checks.finding import Finding

__all__ = ["Finding", "check"]
