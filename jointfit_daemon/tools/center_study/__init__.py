"""Command `jointfit center-study`: repeats the numerical experiment of Akbarifar et al. (2021)."""

from jointfit_daemon.tools.center_study._command import center_study

__all__ = ["center_study"]
