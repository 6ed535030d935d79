"""Estimators, bounds and formulas that experiments and tests compare with the daemon's results."""
