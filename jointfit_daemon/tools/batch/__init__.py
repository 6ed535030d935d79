"""Command `jointfit batch`: processes many recordings with one command."""

from jointfit_daemon.tools.batch._command import batch

__all__ = ["batch"]
