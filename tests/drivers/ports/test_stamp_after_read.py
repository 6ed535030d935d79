"""Stamps of data that arrive while a read is delayed are never earlier than the arrival.

Clock models use the earliest arrivals, so a stamp that is milliseconds early shifts a clock for a
minute. A late stamp has no effect.
"""

from __future__ import annotations

import asyncio
import errno
import fcntl
import os
import socket
import termios
import time
import tty
from array import array
from typing import TYPE_CHECKING, Any

import can
import pytest
from typing_extensions import override

from jointfit_daemon.driver import CanBusSettings
from jointfit_drivers.ports._python_can_bus import PythonCanBus
from jointfit_drivers.ports._socket_stamps import _TIMESTAMPNS
from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_drivers.ports.udp_socket import UdpSocket

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.model import Chunk
    from jointfit_protocols.can import CanFrame

HELD_UP_S = 0.005


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """Yield the far end of a serial line, and the path of its near end."""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield master, os.ttyname(slave)
    os.close(master)
    os.close(slave)


def waiting(fd: int) -> int:
    """Return the number of bytes that can be read."""
    count = array("i", [0])
    fcntl.ioctl(fd, termios.FIONREAD, count)
    return count[0]


async def test_serial_bytes_that_arrive_during_a_delay_are_stamped_after_their_arrival(
    line: tuple[int, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    far, path = line
    came_ns: list[int] = []
    read = os.read

    def held_up(fd: int, size: int) -> bytes:
        time.sleep(HELD_UP_S)
        came_ns.append(time.monotonic_ns())
        os.write(far, b"y")
        while waiting(fd) < 2:  # the kernel needs time to transfer the byte
            time.sleep(0.001)
        return read(fd, size)

    with SerialPort(path, 115200) as port:
        monkeypatch.setattr(os, "read", held_up)
        os.write(far, b"x")
        chunk: Chunk | None = await port.receive(2.0)
    assert chunk is not None
    assert chunk.data == b"xy"
    assert chunk.t_ns >= came_ns[0]


class SlowBus(can.BusABC):
    """A bus with three frames, each of which arrives after the previous frame was read."""

    def __init__(self, reader: int | None) -> None:
        super().__init__(channel="vcan")
        self.came_ns: list[int] = []
        self._reader = reader

    @override
    def fileno(self) -> int:
        if self._reader is None:
            raise NotImplementedError
        return self._reader

    @override
    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        if len(self.came_ns) == 3:
            time.sleep(timeout or 0.0)
            return None, True
        time.sleep(HELD_UP_S)
        self.came_ns.append(time.monotonic_ns())
        data = bytes([len(self.came_ns)])
        return can.Message(arbitration_id=0x21, data=data, timestamp=time.time()), True

    @override
    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


@pytest.mark.parametrize("descriptor", [True, False], ids=["descriptor", "thread"])
async def test_can_frames_that_arrive_during_a_delay_are_stamped_after_their_arrival(
    monkeypatch: pytest.MonkeyPatch,
    descriptor: bool,
) -> None:
    near, far = os.pipe()
    os.write(far, b"x")  # always readable
    bus = SlowBus(near if descriptor else None)
    monkeypatch.setattr(can, "Bus", lambda **_: bus)
    found: list[CanFrame] = []
    stamped: list[int] = []

    def deliver(t_ns: int, frames: list[CanFrame]) -> None:
        found.extend(frames)
        stamped.extend([t_ns] * len(frames))

    opened = PythonCanBus(CanBusSettings(interface="virtual", channel="held-up"))
    await opened.open(deliver, lambda _: None)
    async with asyncio.timeout(5):
        while len(found) < 3:
            await asyncio.sleep(0.01)
    await opened.close()
    os.close(near)
    os.close(far)
    for frame, came_ns, t_ns in zip(found, bus.came_ns, stamped, strict=True):
        assert came_ns <= frame.t_ns <= t_ns  # stamps of the frame and of its chunk


class WithoutStamps:
    """A socket without kernel stamps; the second datagram arrives while the first is read."""

    def __init__(self, actual: Any) -> None:
        self._actual = actual
        self.came_ns: list[int] = []

    def recvmsg(self, size: int, _ancillary: int) -> tuple[bytes, list[Any], int, Any]:
        time.sleep(HELD_UP_S)
        if len(self.came_ns) < 2:
            self.came_ns.append(time.monotonic_ns())
            self._actual.sendto(b"x", self._actual.getsockname())
        data, _, flags, address = self._actual.recvmsg(size, 0)
        return data, [], flags, address


def test_datagrams_without_kernel_stamp_are_stamped_after_their_arrival() -> None:
    opened = UdpSocket("127.0.0.1", 0, sender="127.0.0.1")
    actual = opened._socket
    unstamped = WithoutStamps(actual)
    try:
        opened._socket = unstamped  # type: ignore[assignment]  # has the used methods
        arrivals = opened.receive()
    finally:
        actual.close()
    assert len(arrivals) == 2
    for arrival, came_ns in zip(arrivals, unstamped.came_ns, strict=True):
        assert arrival.t_ns >= came_ns


async def test_a_system_without_stamps_of_network_data_uses_the_time_of_the_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Unstamped(socket.socket):
        @override
        def setsockopt(self, level: int, option: int, *values: Any) -> None:
            if option == _TIMESTAMPNS:
                raise OSError(errno.ENOPROTOOPT, os.strerror(errno.ENOPROTOOPT))
            super().setsockopt(level, option, *values)

    monkeypatch.setattr(socket, "socket", Unstamped)
    opened = UdpSocket("127.0.0.1", 0, sender="127.0.0.1")
    try:
        opened.send(b"x", opened._socket.getsockname())
        await asyncio.sleep(0.05)
        before_ns = time.monotonic_ns()
        (arrival,) = opened.receive()
    finally:
        opened.close()
    assert arrival.data == b"x"
    assert before_ns <= arrival.t_ns <= time.monotonic_ns()
