"""Simulation: an arm drawn from the prior touches the faces of a cell."""
