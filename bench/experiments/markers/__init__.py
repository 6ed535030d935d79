"""Experiments on inverse kinematics and marker refinement."""
