"""Command `jointfit dashboard`: serves the web page of a rig, and a tunnel to the broker."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jointfit_daemon.tools.dashboard._command import dashboard

__all__ = ["dashboard"]


def __getattr__(name: str) -> Any:
    """Return the command. It is imported on demand, so that the server runs without this import."""
    if name != "dashboard":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from jointfit_daemon.tools.dashboard._command import dashboard

    return dashboard
