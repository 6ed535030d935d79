"""The scenery of the conformance suite: a device that serves, a daemon that listens, bad wires.

Law: no driver and no device is named here; claims are made in ``driver_contract``.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
import os
import random
from typing import TYPE_CHECKING, Any, Protocol

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine

    from jointfit_daemon.driver import Driver
    from jointfit_daemon.model import Chunk, Decoded
    from jointfit_simulators.imu_device import Quaternion


class ContractDevice(Protocol):
    """What the suite needs of a simulated device."""

    async def run(self) -> None:
        """Serve until cancelled."""

    def unplug(self) -> None:
        """Take the wire away; again, or on a device that never ran, it does nothing."""

    def plug(self) -> None:
        """Put the wire back."""


def orientation(number: int) -> Quaternion:
    """Return the orientation of sample `number`: each more than 0.1 rad from its neighbours."""
    turn, tilt = 0.06 * number, 0.025 * number
    return (
        math.cos(turn) * math.cos(tilt),
        math.cos(turn) * math.sin(tilt),
        math.sin(turn) * math.sin(tilt),
        math.sin(turn) * math.cos(tilt),
    )


class DecodingReceiver:
    """Stands where the daemon stands: takes chunks, decodes them at once, keeps both."""

    def __init__(self, driver: Driver, measurement: type) -> None:
        self.chunks: list[Chunk] = []
        self.events: list[Decoded] = []
        self.decoder = driver.decoder()
        self._measurement = measurement

    def emit(self, chunk: Chunk) -> None:
        """Take one chunk."""
        self.chunks.append(chunk)
        self.events += self.decoder.feed(chunk)

    async def wait_for(self, count: int, within_s: float) -> None:
        """Wait until `count` measurements are here, or for `within_s`."""
        for _ in range(round(within_s / 0.005)):
            if len(self.measurements) >= count:
                return
            await asyncio.sleep(0.005)

    async def settle(self) -> None:
        """Wait until no more measurements come."""
        seen = -1
        while seen != len(self.measurements):
            seen = len(self.measurements)
            await asyncio.sleep(0.03)

    @property
    def measurements(self) -> list[Any]:
        """Measurements so far."""
        return [event for event in self.events if isinstance(event, self._measurement)]


class SwitchableNoise:
    """A wire that is clean until told otherwise: flips, cuts, repeats and adds bytes."""

    def __init__(self) -> None:
        self.on = False
        self._random = random.Random(7)  # noqa: S311 - the same noise every time

    def __call__(self, data: bytes) -> bytes:
        """Return what arrives of `data`."""
        if not self.on or self._random.random() < 0.6:  # noqa: PLR2004 - four in ten suffer
            return data
        place = self._random.randrange(len(data))
        match self._random.randrange(4):
            case 0:
                bit = self._random.choice((0x01, 0x10, 0x80, 0x80))  # signs are what hurts most
                return data[:place] + bytes((data[place] ^ bit,)) + data[place + 1 :]
            case 1:
                return data[:place]
            case 2:
                return self._random.randbytes(20) + data
            case _:
                return data[:place] + data


def require(condition: object, claim: str) -> None:
    """Raise AssertionError unless `condition`: a driver breaks its contract."""
    if not condition:
        raise AssertionError(f"not so: {claim}")


def run_scene(scene: Coroutine[Any, Any, None]) -> None:
    """Run a scene on a loop of its own, so that the suite needs no plug-in of pytest."""
    asyncio.run(scene)


@contextlib.asynccontextmanager
async def serve_device(device: ContractDevice) -> AsyncIterator[None]:
    """Have the device serve; unplug it at the end."""
    task = asyncio.create_task(device.run())
    try:
        yield
    finally:
        await cancel_and_wait(task)
        device.unplug()


async def cancel_and_wait(task: asyncio.Task[None]) -> None:
    """Cancel and see it end within a second."""
    task.cancel()
    _, late = await asyncio.wait({task}, timeout=1.0)
    require(not late, "a cancelled run ends within a second")
    if not task.cancelled():
        task.result()
        raise AssertionError("not so: a cancelled run raises CancelledError")


async def require_error(kind: type[Exception], task: asyncio.Task[None], within_s: float) -> None:
    """See `task` end with exactly `kind`."""
    _, late = await asyncio.wait({task}, timeout=within_s)
    if late:
        await cancel_and_wait(task)
        raise AssertionError(f"not so: {kind.__name__} within {within_s:g} s")
    error = task.exception()
    if error is not None and type(error) is not kind:
        raise error
    require(error is not None, f"{kind.__name__} is raised, run does not just return")
    require(
        kind not in {DeviceLostError, DeviceMisconfiguredError} or str(error), "it says something"
    )


def count_descriptors() -> int:
    """Return how many descriptors this process has open."""
    return len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - a count, not paths


def content_of(measurement: Any) -> str:
    """Return everything of a measurement but when it arrived."""
    changed: Callable[..., Any] | None = getattr(measurement, "_replace", None)
    if changed is not None:
        return repr(changed(arrival_ns=0))
    return repr([(k, getattr(measurement, k)) for k in _fields(measurement)])


def _fields(measurement: Any) -> list[str]:
    return [name for name in measurement.__dataclass_fields__ if name != "arrival_ns"]
