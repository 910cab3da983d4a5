"""Binding: a problem and its samples become one least-squares problem."""
