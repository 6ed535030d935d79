"""Command `jointfit calibrate sensor`: estimates the errors of one sensor's raw readings."""

from jointfit_daemon.tools.calibrate_sensor._command import calibrate_sensor

__all__ = ["calibrate_sensor"]
