"""Plots of clocks, lags and joint centers."""
