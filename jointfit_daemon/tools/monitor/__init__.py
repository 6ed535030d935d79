"""Command `jointfit monitor`: shows limb, angles, sensors and calibration in a terminal."""

from jointfit_daemon.tools.monitor._command import MonitorUnavailableError, monitor

__all__ = ["MonitorUnavailableError", "monitor"]
