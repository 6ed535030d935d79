"""`jointfit probe`: devices of this host, and the drivers that decode their data."""

from jointfit_daemon.tools.probe._command import probe

__all__ = ["probe"]
