"""Command `jointfit report`: writes a session as one HTML page."""

from jointfit_daemon.tools.report._command import report

__all__ = ["report"]
