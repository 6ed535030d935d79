"""Command `jointfit fuse`: fits, evaluates and applies the fusion of redundant sensors."""

from jointfit_daemon.tools.fuse._command import app

__all__ = ["app"]
