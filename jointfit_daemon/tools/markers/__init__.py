"""Command `jointfit markers`: refines marker positions on segments from motion trials."""

from jointfit_daemon.tools.markers._command import markers

__all__ = ["markers"]
