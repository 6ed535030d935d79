"""`jointfit fuse`: redundant sensors of a limb, fitted, evaluated and applied to recordings."""

from jointfit_daemon.tools.fuse._command import app

__all__ = ["app"]
