"""Studies: many trials of many methods, run anywhere, recorded once, reported from the records alone."""

from casacal.study.description import Method, Run, Setting, Study, Trial
from casacal.study.runs import merge, open_run, run

__all__ = ["Method", "Run", "Setting", "Study", "Trial", "merge", "open_run", "run"]
