"""Changes: whether an arm has changed since it was calibrated, what, by how much, and the result after it."""
