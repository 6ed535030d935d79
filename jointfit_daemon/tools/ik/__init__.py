"""Command `jointfit ik`: computes joint coordinates of a marker trial by inverse kinematics."""

from jointfit_daemon.tools.ik._command import ik

__all__ = ["ik"]
