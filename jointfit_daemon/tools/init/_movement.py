"""Detection of a sensor by its movement, with any IMU driver."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError, find_driver
from jointfit_daemon.model import ImuSample
from jointfit_daemon.tools.init._parsing import AnswerError

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Mapping

    from jointfit_daemon.model import Chunk

TURN_RAD = math.radians(40.0)
"""Rotation that identifies a sensor. A hand easily turns a sensor by 90°."""
REST_SHARE = 0.5
"""Largest rotation of every other sensor, as a share of the rotation of the turned sensor."""
CONNECT_S, LAST_S, TURN_S = 12.0, 4.0, 30.0
"""Three time limits, s: to connect all devices, to wait for a further device after a connection,
and to turn the sensor. Ports without a sensor are common, so the second limit ends the wait early.
"""
_POLL_S = 0.1
_RETRY_S = 0.3
_USUAL_BAUDS = (115_200, 921_600, 460_800, 230_400, 2_000_000)


@dataclass
class _Listener:
    """One device to read, with its rotation or the reason why it sends no data."""

    table: dict[str, Any]
    reason: str = "no answer yet"
    start: tuple[float, ...] | None = None
    turned_rad: float = 0.0

    def take(self, q: tuple[float, ...]) -> None:
        """Process an orientation: store the largest rotation relative to the first orientation."""
        if self.start is None:
            self.start = q
        dot = abs(sum(a * b for a, b in zip(self.start, q, strict=True)))
        cross = math.sqrt(max(0.0, 1.0 - min(1.0, dot) ** 2))
        self.turned_rad = max(self.turned_rad, 2.0 * math.atan2(cross, dot))

    async def run(self, rate_hz: float) -> None:
        """Read the device until cancelled; each attempt to connect uses another speed."""
        driver_class = find_driver(self.table["driver"])
        has_baud = "baud" in driver_class.Settings.model_fields
        speeds = getattr(driver_class, "usual_bauds", _USUAL_BAUDS) if has_baud else (None,)
        attempt = 0
        while True:
            more = {} if speeds[0] is None else {"baud": speeds[attempt % len(speeds)]}
            attempt += 1
            table = {**self.table, **more, "rate_hz": rate_hz, "id": "sensor", "segment": "any"}
            driver = driver_class(driver_class.Settings(**table))
            decoder = driver.decoder()

            def emit(chunk: Chunk, decoder: Any = decoder, more: dict[str, Any] = more) -> None:
                for item in decoder.feed(chunk):
                    if isinstance(item, ImuSample):
                        self.table |= more
                        self.take(tuple(item.q_world_sensor))

            try:
                await driver.run(emit)
            except (DeviceLostError, DeviceMisconfiguredError) as error:
                self.reason = str(error)
            await asyncio.sleep(_RETRY_S)


async def find_moved(
    sensor: str,
    tables: Mapping[str, Mapping[str, Any]],
    rate_hz: float,
    show: Callable[[str], None],
) -> tuple[str, dict[str, Any]]:
    """Return the address and table of the device that is turned while the other devices rest.

    Parameters
    ----------
    sensor
        Name of the sensor, for messages.
    tables
        Keys of ``[[imu]]`` of each device, by its address.
    rate_hz
        Rate to which the devices are set, Hz.
    show
        Function that prints a line.

    Raises
    ------
    AnswerError
        No device sends orientations, or no device was turned while the others rested.
    """
    listeners = {address: _Listener(dict(table)) for address, table in tables.items()}
    tasks = [asyncio.create_task(each.run(rate_hz)) for each in listeners.values()]
    try:
        await _connect(listeners.values())
        ready = {address: each for address, each in listeners.items() if each.start is not None}
        for address in listeners.keys() - ready.keys():
            show(f"  {address} sends no orientation: {listeners[address].reason}")
        if not ready:
            raise AnswerError("no sensor sends orientations: connect it, or choose from the list")

        for each in ready.values():
            each.start, each.turned_rad = None, 0.0
        show(f"  Turn the sensor {sensor} by a quarter turn now ({TURN_S:g} s) …")
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(TURN_S):
                while _turned_address(ready) is None:  # noqa: ASYNC110 - facts of several devices
                    await asyncio.sleep(_POLL_S)
        turned = _turned_address(ready)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
    if turned is None:
        turns = ", ".join(
            f"{name} {math.degrees(each.turned_rad):.0f}°" for name, each in ready.items()
        )
        raise AnswerError(
            f"no sensor was turned alone ({turns}): turn {sensor} by a quarter turn and hold the"
            " others still, or choose from the list"
        )
    return turned, ready[turned].table


async def _connect(listeners: Collection[_Listener]) -> None:
    """Wait until the devices send orientations, within the time limits."""
    count, since = 0, time.monotonic()
    until = since + CONNECT_S
    while (now := time.monotonic()) < until:
        ready = sum(each.start is not None for each in listeners)
        if ready > count:
            count, since = ready, now
        if count == len(listeners) or (count and now > since + LAST_S):
            return
        await asyncio.sleep(_POLL_S)


def _turned_address(listeners: Mapping[str, _Listener]) -> str | None:
    """Return the address of the only device that was turned; None if no device or several were."""
    first, *others = sorted(listeners.items(), key=lambda entry: entry[1].turned_rad, reverse=True)
    second = others[0][1].turned_rad if others else 0.0
    is_clear = first[1].turned_rad >= TURN_RAD and second <= REST_SHARE * first[1].turned_rad
    return first[0] if is_clear else None
