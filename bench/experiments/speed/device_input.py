"""CPU time per message on an event loop, for readers of the daemon and of other packages.

The messages are read from a pseudo-terminal (pty). Only one message is in transit at a time, so
each message wakes the loop once. The receiver writes the next message, and the CPU time of writing
is subtracted. The lower limit is the time of a loop that only reads.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import statistics
import time
import tty
from dataclasses import replace
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, TypeAlias

import can
from typing_extensions import override

from bench.framework.measurement import speed_experiment, timed_result
from bench.subjects import device_bytes
from bench.subjects.simulated_wearer import walking
from jointfit_daemon.driver import CanBusSettings
from jointfit_drivers.ports.can_bus import shared_bus
from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_protocols.xcdi import XcdiIds

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Coroutine
    from contextlib import AbstractAsyncContextManager

    from bench.framework.experiment import Result

MESSAGES = 400
ROUNDS, QUICK_ROUNDS = 15, 3
BAUD = 921_600
PERIOD_NS = 10_000_000
LONGEST_S = 60.0
UVLOOP = " on uvloop"
"""Suffix of the names of readers that run on uvloop instead of the asyncio loop."""
IDS = XcdiIds(5, 6, 33, status_word=None, error=None)

Take: TypeAlias = "Callable[[], None]"
Reader: TypeAlias = "Callable[[_Line, Take], AbstractAsyncContextManager[None]]"


class _Line:
    """Pseudo-terminal (pty) that sends a message when the previous message was received."""

    def __init__(self, messages: list[bytes]) -> None:
        self._far, self.near = pty.openpty()
        tty.setraw(self.near)
        self.path = os.ttyname(self.near)
        self._messages = messages
        self._left = 0
        self._writing_s = 0.0
        self._done: asyncio.Future[None] | None = None

    async def cost_s(self) -> float:
        """Return the CPU time per message on the running loop, s."""
        self._left, self._writing_s = len(self._messages), 0.0
        self._done = asyncio.get_running_loop().create_future()
        began = time.thread_time()
        self._send()
        async with asyncio.timeout(LONGEST_S):
            await self._done
        return (time.thread_time() - began - self._writing_s) / len(self._messages)

    def take(self) -> None:
        """Record that a message was received."""
        if self._left:
            self._send()
        elif self._done is not None and not self._done.done():
            self._done.set_result(None)

    def _send(self) -> None:
        self._left -= 1
        began = time.thread_time()
        os.write(self._far, self._messages[self._left])
        self._writing_s += time.thread_time() - began

    def close(self) -> None:
        os.close(self._far)
        os.close(self.near)


@contextlib.asynccontextmanager
async def _bare(line: _Line, take: Take) -> AsyncIterator[None]:
    def readable() -> None:
        os.read(line.near, 4096)
        take()

    loop = asyncio.get_running_loop()
    loop.add_reader(line.near, readable)
    try:
        yield
    finally:
        loop.remove_reader(line.near)


@contextlib.asynccontextmanager
async def _running(work: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
    task = asyncio.create_task(work)
    await asyncio.sleep(0.05)  # wait until the reader is ready
    try:
        yield
    finally:
        task.cancel()
        await asyncio.wait([task])


@contextlib.asynccontextmanager
async def _serial_port(line: _Line, take: Take) -> AsyncIterator[None]:
    with SerialPort(line.path, BAUD) as port:
        async with _running(port.pump(lambda _: take(), 5.0)):
            yield


@contextlib.asynccontextmanager
async def _pyserial_asyncio_fast(line: _Line, take: Take) -> AsyncIterator[None]:
    import serial_asyncio_fast  # noqa: PLC0415 - for comparison, may be missing

    class Receiver(asyncio.Protocol):
        @override
        def data_received(self, data: bytes) -> None:
            del data
            take()

    transport, _ = await serial_asyncio_fast.create_serial_connection(
        asyncio.get_running_loop(), Receiver, line.path, baudrate=BAUD
    )
    try:
        yield
    finally:
        transport.close()
        await asyncio.sleep(0.05)


@contextlib.asynccontextmanager
async def _shared_bus(line: _Line, take: Take) -> AsyncIterator[None]:
    needed = (IDS.quaternion or 0, False)
    settings = CanBusSettings(interface="slcan", channel=line.path, baud=115_200)
    async with shared_bus(settings) as bus:
        pumping = bus.pump("S1", {needed: "orientation"}, lambda _: take(), 5.0, needed=needed)
        async with _running(pumping):
            yield


@contextlib.asynccontextmanager
async def _notifier(line: _Line, take: Take) -> AsyncIterator[None]:
    bus: Any = can.Bus(interface="slcan", channel=line.path, sleep_after_open=0)
    notifier = can.Notifier(  # noqa: TID251 - for comparison
        bus, [lambda _: take()], loop=asyncio.get_running_loop()
    )
    try:
        yield
    finally:
        notifier.stop()
        bus.shutdown()


async def _measure(messages: list[bytes], reader: Reader) -> float:
    """Return the CPU time per message, s."""
    line = _Line(messages)
    try:
        async with reader(line, line.take):
            return await line.cost_s()
    finally:
        line.close()


def _fast_loop() -> asyncio.AbstractEventLoop:
    import uvloop  # noqa: PLC0415 - for comparison, may be missing

    loop: asyncio.AbstractEventLoop = uvloop.new_event_loop()
    return loop


def _rows(
    name: str, messages: list[bytes], readers: dict[str, Reader], quick: bool
) -> list[Result]:
    """Return the times of all readers, and the ratios of the first reader (ours) to the others."""
    times: dict[str, list[float]] = {reader: [] for reader in readers}
    for _ in range(QUICK_ROUNDS if quick else ROUNDS):  # all readers alternate
        for reader, read in readers.items():
            loop = _fast_loop if reader.endswith(UVLOOP) else asyncio.new_event_loop
            with asyncio.Runner(loop_factory=loop) as runner:
                times[reader].append(runner.run(_measure(messages, read)))
    rows = [
        timed_result(f"{name}: {reader}", round(1e6 * statistics.median(found), 1), "µs")
        for reader, found in times.items()
    ]
    ours, *others = readers
    for other in others:
        ratios = [a / b for a, b in zip(times[ours], times[other], strict=True)]
        bare, peer = other == "bare loop", not other.endswith(UVLOOP)
        target, threshold = (1.3 if bare else 1.0, None if bare else 1.5) if peer else (None, None)
        ratio = round(statistics.median(ratios), 3)
        rows.append(timed_result(f"{name}: time ratio to {other}", ratio, "", target, threshold))
    return rows


def serial_rows(quick: bool) -> list[Result]:
    """Return the times for messages of an Xbus device."""
    messages = device_bytes.xbus_messages(walking("S1", 100.0, MESSAGES / 100.0), PERIOD_NS)
    readers: dict[str, Reader] = {
        "jointfit": _serial_port,
        "bare loop": _bare,
        "pyserial-asyncio-fast": _pyserial_asyncio_fast,
    }
    if find_spec("uvloop") is not None:
        readers[f"jointfit{UVLOOP}"] = _serial_port
    return _rows("UART input, one message", messages, readers, quick)


def can_rows(quick: bool) -> list[Result]:
    """Return the times for CAN frames of an SLCAN adapter, each with an orientation."""
    orientations = walking("S1", 100.0, MESSAGES / 100.0)
    groups = device_bytes.xcdi_frames(orientations, PERIOD_NS, IDS)
    messages = device_bytes.slcan_lines([group[-1:] for group in groups])
    readers: dict[str, Reader] = {
        "jointfit": _shared_bus,
        "bare loop": _bare,
        "python-can Notifier": _notifier,
    }
    return _rows("SLCAN input, one frame", messages, readers, quick)


EXPERIMENTS = (
    replace(
        speed_experiment("serial-input-time", "UART input on the event loop", serial_rows),
        packages=("serial_asyncio_fast",),
    ),
    speed_experiment("can-input-time", "SLCAN input on the event loop", can_rows),
)
