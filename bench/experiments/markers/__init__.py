"""Inverse kinematics and marker refinement."""
