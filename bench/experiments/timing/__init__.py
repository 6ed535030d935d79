"""Clocks, lag, alignment and memory."""
