"""Samples: validated rows of joint values and readings, from tables of any kind."""
