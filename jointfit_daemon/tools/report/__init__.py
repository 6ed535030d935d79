"""`jointfit report`: published experiments repeated, as tables and figures."""

from jointfit_daemon.tools.report._command import report

__all__ = ["report"]
