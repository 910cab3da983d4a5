"""Simulation: an arm drawn from its prior touches the faces of a cell."""
