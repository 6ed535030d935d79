"""`jointfit demo`: the daemon on simulated hardware, compared with the simulated bones."""

from jointfit_daemon.tools.demo._command import demo

__all__ = ["demo"]
