"""The seam: what estimators see of a problem, and what they return. NumPy alone."""
