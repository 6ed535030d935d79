"""`jointfit replay`: runs a recording through the core again, verifies it, or publishes it."""

from jointfit_daemon.tools.replay._command import replay

__all__ = ["replay"]
