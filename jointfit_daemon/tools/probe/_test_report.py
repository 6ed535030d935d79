"""Result of a physical test, as lines of text."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.physical_test import ROTATIONS, correction_lines

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.physical_test import PhysicalTestResult


def test_lines(result: PhysicalTestResult) -> Iterator[str]:
    """Yield the measured rotations, the outcome, and the changes to make in rig.toml."""
    for rotation, deviation in zip(ROTATIONS, result.deviations_deg, strict=True):
        yield f"{rotation}: {deviation:.0f} deg from the requested rotation"
    yield f"{result.id} sends: {result.found}"
    yield from correction_lines(result)
