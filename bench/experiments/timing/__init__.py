"""Experiments on clocks, lag, alignment and memory."""
