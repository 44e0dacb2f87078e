"""Physical constants (CODATA 2018)."""

EPS0 = 8.8541878128e-12
"""Vacuum permittivity [F/m]."""
