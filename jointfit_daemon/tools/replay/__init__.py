"""Command `jointfit replay`: processes a recording again, verifies it, or publishes it."""

from jointfit_daemon.tools.replay._command import replay

__all__ = ["replay"]
