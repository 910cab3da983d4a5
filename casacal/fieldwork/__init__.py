"""Handouts of a plan: moves for a controller, a sheet to write on, set-ups to choose from."""
