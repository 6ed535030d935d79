"""`jointfit markers`: marker positions on their segments, refined from motion trials."""

from jointfit_daemon.tools.markers._command import markers

__all__ = ["markers"]
