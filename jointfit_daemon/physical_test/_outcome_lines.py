"""Outcome of a physical test as text, which is the same in the terminal and in the dashboard."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.physical_test._physical_test import PhysicalTestResult

ROTATIONS = ("about the vertical", "about its x axis", "about the vertical, tipped")
"""Names of the three rotations."""


def correction_lines(result: PhysicalTestResult) -> Iterator[str]:
    """Yield the outcome and, if needed, the lines of rig.toml that correct the orientations."""
    if result.agrees:
        yield f"{result.id}: world, axes and direction are as configured"
        return

    yield f"{result.id}: not as configured"
    if result.rig_toml:
        yield f"in its [[imu]] table of rig.toml:\n{result.rig_toml[0]}"
        for other in result.alternatives:
            yield f"or, with another heading:\n{other}"
    else:
        yield (
            "no setting of its driver corrects this: set the device to a world with z up and the "
            "axes printed on it, or select another driver"
        )
