"""Guided test of one sensor: three rotations by hand, which check the configured frames.

The driver runs as in the daemon. `jointfit_daemon.physical_test` evaluates the chunks from the
driver.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.physical_test import STEPS, PhysicalTest, PhysicalTestResult

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.config import Source
    from jointfit_daemon.model import Chunk

OPEN_S = 20.0
"""Time limit from opening the device to the first orientation, s. It includes a search at other
speeds."""


class PhysicalTestError(Exception):
    """The device is lost or misconfigured, sends no orientation, or a rotation took too long."""


async def run_physical_test(
    source: Source, tell: Callable[[str], None], *, step_s: float
) -> PhysicalTestResult:
    """Guide the user through the rotations, and evaluate them.

    Parameters
    ----------
    source
        Sensor of a rig.
    tell
        Function that shows an instruction.
    step_s
        Time limit of a step, s.

    Raises
    ------
    PhysicalTestError
        The device is lost or misconfigured, sends no orientation, or a step took longer than
        `step_s`.
    """
    test, changed = PhysicalTest(source), asyncio.Event()

    def emit(chunk: Chunk) -> None:
        before = test.has_orientation, len(test.rests)
        test.add(chunk)
        if before != (test.has_orientation, len(test.rests)):
            changed.set()

    # A silent device is reported before any instruction.
    tell(f"Opening {source.id} …")
    reading = asyncio.create_task(source.driver_class(source.settings).run(emit))
    try:
        if not await _wait_for_change(source.id, reading, changed, OPEN_S):
            raise PhysicalTestError(
                f"{source.id}: no orientation within {OPEN_S:g} s: `jointfit doctor` names the "
                "cause"
            )
        test.begin()
        for step in STEPS:
            tell(step.format(id=source.id))
            if not await _wait_for_change(source.id, reading, changed, step_s):
                raise PhysicalTestError(
                    f"{source.id}: no rest in a new orientation within {step_s:g} s: repeat the "
                    "test, and hold the sensor still for a second after each rotation"
                )
    finally:
        reading.cancel()
        await asyncio.wait([reading])
    return test.result()


async def _wait_for_change(
    name: str, reading: asyncio.Task[None], changed: asyncio.Event, limit_s: float
) -> bool:
    """Return whether `changed` was set within `limit_s`, and clear it.

    Raises
    ------
    PhysicalTestError
        The driver ended before the event was set.
    """
    waiting = asyncio.create_task(changed.wait())
    await asyncio.wait({waiting, reading}, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
    waiting.cancel()
    if reading.done():
        error = reading.exception()
        if isinstance(error, DeviceLostError | DeviceMisconfiguredError):
            raise PhysicalTestError(f"{name}: {error}") from error
        reading.result()
    was_set = changed.is_set()
    changed.clear()
    return was_set
