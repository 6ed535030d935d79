"""Command `jointfit center-study`: repeats a published numerical experiment."""

from jointfit_daemon.tools.center_study._command import center_study

__all__ = ["center_study"]
