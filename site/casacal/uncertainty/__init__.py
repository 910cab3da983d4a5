"""Uncertainty: what the data tell, what they cannot tell, and what would cure it."""
