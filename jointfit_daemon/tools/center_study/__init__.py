"""`jointfit center-study`: repeats a published experiment and writes tables and figures."""

from jointfit_daemon.tools.center_study._command import center_study

__all__ = ["center_study"]
