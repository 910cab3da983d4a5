"""A page beside the robot: the way from the cell to corrected targets, served to a browser on this machine."""
