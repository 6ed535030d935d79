"""Command `jointfit demo`: runs the daemon on simulated hardware and checks its angles."""

from jointfit_daemon.tools.demo._command import demo

__all__ = ["demo"]
