"""Receiver, device interface and wire noise for the conformance suite of drivers.

Invariant: the module names no driver and no device.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import math
import os
import random
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol

from jointfit_daemon.driver import (
    DeviceLostError,
    DeviceMisconfiguredError,
    driver_names,
    find_driver,
)
from jointfit_daemon.model import ImuSample

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from jointfit_daemon.driver import Driver
    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_simulators.imu_device import Quaternion

_POLL_S = 0.005
"""Time between two checks for new measurements, s."""
_SETTLE_S = 0.03
"""Time without a new measurement after which all measurements have arrived, s."""
_CLEAN_SHARE = 0.6
"""Share of the messages that the noise does not change."""


class ContractDevice(Protocol):
    """Simulated device of the conformance suite."""

    async def run(self) -> None:
        """Run the device until cancelled."""

    def unplug(self) -> None:
        """Disconnect the wire; without effect if it is disconnected, or before ``run``."""

    def plug(self) -> None:
        """Connect the wire."""


def orientation(number: int) -> Quaternion:
    """Return the orientation of sample `number`; it differs by 0.13 rad from its neighbours."""
    turn, tilt = 0.06 * number, 0.025 * number
    return (
        math.cos(turn) * math.cos(tilt),
        math.cos(turn) * math.sin(tilt),
        math.sin(turn) * math.sin(tilt),
        math.sin(turn) * math.cos(tilt),
    )


class DecodingReceiver:
    """Receiver that replaces the daemon; it decodes each chunk and stores chunks and events."""

    def __init__(self, driver: Driver, measurement: type) -> None:
        self.chunks: list[Chunk] = []
        self.events: list[Decoded] = []
        self.decoder = driver.decoder()
        self._measurement = measurement

    def restarted(self, driver: Driver) -> DecodingReceiver:
        """Return a receiver with a new decoder and no chunks."""
        return DecodingReceiver(driver, self._measurement)

    def emit(self, chunk: Chunk) -> None:
        """Store and decode one chunk."""
        self.chunks.append(chunk)
        self.events += self.decoder.feed(chunk)

    async def wait_for(self, count: int, within_s: float) -> None:
        """Wait until `count` measurements have arrived, but at most `within_s`, s."""
        for _ in range(round(within_s / _POLL_S)):
            if len(self.measurements) >= count:
                return
            await asyncio.sleep(_POLL_S)

    async def settle(self) -> None:
        """Wait until no further measurements arrive."""
        before = -1
        while before != len(self.measurements):
            before = len(self.measurements)
            await asyncio.sleep(_SETTLE_S)

    @property
    def measurements(self) -> list[Any]:
        """All measurements received so far."""
        return [event for event in self.events if isinstance(event, self._measurement)]


class SwitchableNoise:
    """Wire noise that flips bits, truncates, inserts bytes and repeats parts while `on`."""

    def __init__(self) -> None:
        self.on = False
        self._random = random.Random(7)  # noqa: S311 - the same noise in every run

    def __call__(self, data: bytes) -> bytes:
        """Return `data` with the damage of the wire."""
        if not self.on or self._random.random() < _CLEAN_SHARE:
            return data

        place = self._random.randrange(len(data))
        match self._random.randrange(4):
            case 0:
                # Sign bits are chosen more often, because their errors are the largest.
                bit = self._random.choice((0x01, 0x10, 0x80, 0x80))
                return data[:place] + bytes((data[place] ^ bit,)) + data[place + 1 :]
            case 1:
                return data[:place]
            case 2:
                return self._random.randbytes(20) + data
            case _:
                return data[:place] + data


def require(condition: object, requirement: str) -> None:
    """Raise AssertionError with the text `requirement` unless `condition` is true."""
    if not condition:
        raise AssertionError(f"contract violated: {requirement}")


@contextlib.asynccontextmanager
async def serve_device(device: ContractDevice) -> AsyncIterator[None]:
    """Run the device during the ``async with`` block; disconnect it at the end."""
    task = asyncio.create_task(device.run())
    try:
        yield
    finally:
        await cancel_and_wait(task)
        device.unplug()


async def cancel_and_wait(task: asyncio.Task[None]) -> None:
    """Cancel a task and require that it ends with CancelledError within a second."""
    if task.done() and not task.cancelled() and task.exception() is None:
        require(False, "run must read until it is cancelled; it returned")
    task.cancel()
    _, pending = await asyncio.wait({task}, timeout=1.0)
    require(not pending, "a cancelled run must end within a second")
    if not task.cancelled():
        task.result()  # raises the exception of the task, if any
    require(task.cancelled(), "a cancelled run must raise CancelledError")


async def require_error(kind: type[Exception], task: asyncio.Task[None], within_s: float) -> None:
    """Require that `task` raises `kind` within `within_s`, s."""
    _, pending = await asyncio.wait({task}, timeout=within_s)
    if pending:
        await cancel_and_wait(task)
    require(not pending, f"run must raise {kind.__name__} within {within_s:g} s")

    error = task.exception()
    if error is not None and not isinstance(error, kind):
        raise error
    require(error is not None, f"run must raise {kind.__name__}; it returned")
    require(
        kind not in {DeviceLostError, DeviceMisconfiguredError} or str(error),
        f"{kind.__name__} must have a message",
    )


def count_descriptors() -> int:
    """Return the number of open descriptors of this process."""
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - a count, not paths


def content_of(measurement: Any) -> str:
    """Return all values of a measurement except its arrival time."""
    replace = getattr(measurement, "_replace", None) or partial(dataclasses.replace, measurement)
    return repr(replace(arrival_ns=0))


def content_text(measurement: Any) -> str:
    """Return the orientation of a sample, or all values of another measurement, as text."""
    if not isinstance(measurement, ImuSample):
        return repr(measurement)
    return f"q_world_sensor = {_round_values(measurement.q_world_sensor)}"


def expected_text(measurement: Any, number: int) -> str:
    """Return the expected value of sample `number` as text for an error message."""
    if not isinstance(measurement, ImuSample):
        return f", expected number {number}"
    text = _round_values(orientation(number))
    return f", expected {text}: check the order of the components, the world and the direction"


def _round_values(q: Quaternion) -> str:
    return f"({', '.join(f'{part:.3f}' for part in q)})"


def find_installed(name: str) -> type[Driver]:
    """Return the driver of an entry point; require that the driver is installed."""
    require(
        name in driver_names(),
        f"entry point {name!r} must be installed; installed are {', '.join(driver_names())}: run "
        "`python -m pip install --editable .` in the folder of the package, and again after a "
        "change of its pyproject.toml",
    )
    return find_driver(name)
