"""Experiments on lost, stuck and slipping sensors, heading drift, and magnetic disturbance."""
