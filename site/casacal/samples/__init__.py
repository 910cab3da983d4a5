"""Samples: validated rows of joint values and readings."""
