"""Robots in files: DH tables in CSV and TOML, and URDF."""
