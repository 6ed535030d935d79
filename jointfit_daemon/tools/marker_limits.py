"""Comparison of marker errors with the limits of `kinematics.accepted_errors`, as text."""

from __future__ import annotations

SOURCE = "OpenSim best practices"


def comparison(name: str, error: float, limit: float) -> str:
    """Return an error, m, and its comparison with the limit, as text in mm."""
    words = "below" if error < limit else "ABOVE"
    return f"{name} {1000 * error:.1f} mm, {words} {1000 * limit:g} mm"
