"""`jointfit dashboard`: the web page of a rig, and a tunnel from the page to the broker."""

from jointfit_daemon.tools.dashboard._command import dashboard

__all__ = ["dashboard"]
