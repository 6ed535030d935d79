"""`jointfit center-study`: a published experiment repeated, as tables and figures."""

from jointfit_daemon.tools.center_study._command import center_study

__all__ = ["center_study"]
