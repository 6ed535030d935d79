"""`jointfit calibrate sensor`: errors of one sensor's raw readings, by guided movements."""

from jointfit_daemon.tools.calibrate_sensor._command import calibrate_sensor

__all__ = ["calibrate_sensor"]
