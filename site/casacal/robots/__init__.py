"""Robots: the value, the ways to describe one (DH, screws, URDF), and what their joint values mean."""
