"""Command `jointfit doctor`: finds the faults that keep data from the daemon."""

from jointfit_daemon.tools.doctor._command import doctor

__all__ = ["doctor"]
