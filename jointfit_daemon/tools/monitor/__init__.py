"""`jointfit monitor`: limb, joint angles, sensors and calibration of a rig in a terminal."""

from jointfit_daemon.tools.monitor._command import MonitorUnavailableError, monitor

__all__ = ["MonitorUnavailableError", "monitor"]
