"""The symbolic model: kinematics, unknowns, robots, instruments, and the problem that joins them."""
