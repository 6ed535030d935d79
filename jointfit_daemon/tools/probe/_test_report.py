"""Result of a physical test, as lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.tools.probe._physical_test import PhysicalTestResult

_ROTATIONS = ("about the vertical", "about its x axis", "about the vertical, tipped")


def test_lines(result: PhysicalTestResult) -> Iterator[str]:
    """Yield the measured rotations, the verdict, and what to change in rig.toml."""
    for rotation, deviation in zip(_ROTATIONS, result.deviations_deg, strict=True):
        yield f"{rotation}: {deviation:.0f} deg from the rotation that was asked for"
    yield f"{result.id} sends: {result.found}"
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
