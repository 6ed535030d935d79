"""Experiments on the fusion of redundant sensors: recordings, simulations, online learning."""
