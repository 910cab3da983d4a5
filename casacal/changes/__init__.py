"""Changes: whether an arm has changed since it was calibrated, what, and by how much."""
