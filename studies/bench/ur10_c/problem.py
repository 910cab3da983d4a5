"""The same arm as in ur10_b, in another series."""

from pathlib import Path

from casacal import load_problem

problem = load_problem(Path(__file__).parent.parent / "ur10_b").problem
