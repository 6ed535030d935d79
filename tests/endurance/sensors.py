"""Process with the four sensors of ``make endurance``, which move in accelerated time.

At each wake-up, a sensor sends all due samples in one write. A message is encoded once for all
sensors with the same output configuration. Samples that were due more than `BATCH` samples ago are
skipped, like the samples of a real sensor while its host is paused.

Invariant: a machine too slow for the factor ends the process with an error; it never blocks the
event loop.
"""

from __future__ import annotations

import asyncio
import math
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jointfit_protocols.xbus import XbusMessageId, encode
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators.devices import XbusDevice, XbusDeviceOptions

if TYPE_CHECKING:
    from collections.abc import Iterable

SENSORS = ("S1", "S2", "S3", "S4")
RATE_HZ = 400
"""Sample rate of each sensor in accelerated time, Hz."""
PERIOD_NS = 1_000_000_000 // RATE_HZ
WAKE_S = 0.016
"""Time between two transmissions of the due samples, s of accelerated time. A USB adapter delivers
the samples of 16 ms together."""
BATCH = RATE_HZ
"""Largest number of samples in one transmission: a second of accelerated time."""
SLOW_WAKES = 20
"""Number of successive transmissions with skipped samples after which the machine is too slow."""
TURN_RAD_S = 0.8
"""Angular frequency of the movement, rad/s; its amplitude is 1 rad."""


class TooSlowError(Exception):
    """The machine cannot send the samples at this factor."""


@dataclass(frozen=True, slots=True)
class Movement:
    """Accelerated time, and the angle of all sensors as a function of this time."""

    factor: int
    begin_ns: int = field(default_factory=time.monotonic_ns)
    """Instant at which accelerated and real time agree, ns of CLOCK_MONOTONIC."""

    @property
    def due(self) -> int:
        """Number of samples of each sensor that are due."""
        return (time.monotonic_ns() - self.begin_ns) * self.factor // PERIOD_NS

    @property
    def samples_per_s(self) -> int:
        """Number of samples of all sensors per second of real time."""
        return RATE_HZ * len(SENSORS) * self.factor

    def angle(self, elapsed_ns: int) -> float:
        """Return the angle, rad, `elapsed_ns` of accelerated time after the start."""
        return math.sin(TURN_RAD_S * elapsed_ns * 1e-9)


class BatchDevice(XbusDevice):
    """Device that sends messages which were encoded before."""

    def message(self, number: int, angle: float) -> bytes:
        """Return the message of a sample in the output configuration of this device."""
        ticks = self._ticks(number * PERIOD_NS) % self._modulus
        q = (math.cos(angle / 2), math.sin(angle / 2), 0.0, 0.0)
        return encode(XbusMessageId.MT_DATA2, self._content(number % (1 << 16), ticks, q, {}))

    def send(self, wire: bytes) -> None:
        """Send messages now in measurement mode; a full line loses all of them."""
        if self.streaming:
            self._write(wire)


class Sensors:
    """The sensors on their serial lines."""

    def __init__(self, folder: Path, movement: Movement) -> None:
        outputs = (*XbusDeviceOptions().outputs[:-1], (Item.QUATERNION, RATE_HZ))
        options = XbusDeviceOptions(outputs=outputs)
        self.devices = [BatchDevice(folder / name, options=options) for name in SENSORS]
        self.movement = movement
        self.number = self.skipped = 0
        self._slow_wakes = 0

    def send_until(self, due: int) -> None:
        """Send the samples up to number `due`.

        Raises
        ------
        TooSlowError
            Samples were skipped in `SLOW_WAKES` successive transmissions.
        """
        numbers = range(max(self.number, due - BATCH) + 1, due + 1)
        skipped = due - self.number - len(numbers)
        self.number, self.skipped = due, self.skipped + skipped
        self._slow_wakes = self._slow_wakes + 1 if skipped else 0
        if self._slow_wakes == SLOW_WAKES:
            raise TooSlowError(
                f"{self.skipped} of {due} samples of each sensor were not sent in time, expected"
                f" none: this machine is too slow for --factor {self.movement.factor}, choose a"
                " smaller one"
            )

        wires: dict[Any, bytes] = {}
        for device in self.devices:
            if device.outputs not in wires:
                wires[device.outputs] = b"".join(self._messages(device, numbers))
            device.send(wires[device.outputs])

    def _messages(self, device: BatchDevice, numbers: Iterable[int]) -> Iterable[bytes]:
        for number in numbers:
            yield device.message(number, self.movement.angle(number * PERIOD_NS))

    async def run(self) -> None:
        """Answer the host and send samples until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            for device in self.devices:
                tasks.create_task(device.run())
            while True:
                self.send_until(self.movement.due)
                await asyncio.sleep(WAKE_S / self.movement.factor)


def main(folder: str, factor: str, begin_ns: str) -> None:
    """Run the sensors; exit with a message if this machine is too slow."""
    sensors = Sensors(Path(folder), Movement(int(factor), int(begin_ns)))
    try:
        asyncio.run(sensors.run())
    except ExceptionGroup as group:
        slow = group.subgroup(TooSlowError)
        if slow is None:
            raise
        # Not in `except*`: Python 3.11.2 puts the SystemExit into a group and prints a traceback.
        sys.exit(str(slow.exceptions[0]))


if __name__ == "__main__":
    main(*sys.argv[1:])
