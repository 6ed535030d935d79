"""Command `jointfit probe`: lists devices of this host, and drivers that decode their data."""

from jointfit_daemon.tools.probe._command import probe

__all__ = ["probe"]
