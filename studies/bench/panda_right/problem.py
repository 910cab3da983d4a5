"""The right arm beside that of panda_left, of the same type."""

from pathlib import Path

from casacal import load_problem

problem = load_problem(Path(__file__).parent.parent / "panda_left").problem
