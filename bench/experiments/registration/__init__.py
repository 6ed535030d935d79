"""Experiments on rest detection, sensor and world alignment, and orientation on the gateway."""
