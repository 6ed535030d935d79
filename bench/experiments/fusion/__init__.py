"""Fusion of redundant sensors: recorded movements, simulated subjects, online learning."""
