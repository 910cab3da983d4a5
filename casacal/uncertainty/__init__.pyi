"""Public names of this chapter and the modules that define them; `__init__.py` reads them from here when it runs."""

from casacal.uncertainty.priors import LearnedPriors as LearnedPriors
from casacal.uncertainty.priors import learned_priors as learned_priors
