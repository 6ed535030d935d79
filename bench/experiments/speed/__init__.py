"""Experiments on CPU time, latency and memory."""
