"""Serial ports on ptys: reading, writing, and the end of a connection."""

from __future__ import annotations

import asyncio
import errno
import os
import termios
import time
import tty
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import serial

from jointfit_daemon.driver import DeviceAbsentError, DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.ports.serial_port import SerialPort

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.model import Chunk


class Pty:
    def __init__(self) -> None:
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)

    def close(self) -> None:
        for fd in (self.master, self.slave):
            try:
                os.close(fd)
            except OSError:
                continue


@pytest.fixture
def pty() -> Iterator[Pty]:
    made = Pty()
    yield made
    made.close()


async def test_bytes_arrive_stamped_with_the_monotonic_clock(pty: Pty) -> None:
    chunks: list[Chunk] = []
    before = time.monotonic_ns()
    with SerialPort(pty.path, 115200) as port:
        task = asyncio.create_task(port.pump(chunks.append, 1.0))
        os.write(pty.master, b"\x00\x11\x13\r\n\xff")
        await asyncio.sleep(0.05)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
    assert b"".join(chunk.data for chunk in chunks) == b"\x00\x11\x13\r\n\xff"
    assert before < chunks[0].t_ns < time.monotonic_ns()


async def test_silence_is_a_lost_device(pty: Pty) -> None:
    with (
        SerialPort(pty.path, 115200) as port,
        pytest.raises(DeviceLostError, match=r"silent for 0.05"),
    ):
        await port.pump(lambda _: None, 0.05)


async def test_each_byte_restarts_the_silence(pty: Pty) -> None:
    with SerialPort(pty.path, 115200) as port:
        task = asyncio.create_task(port.pump(lambda _: None, 0.2))
        for _ in range(5):
            await asyncio.sleep(0.08)
            os.write(pty.master, b"x")
        assert not task.done()
        with pytest.raises(DeviceLostError):
            await task


async def test_unplugging_is_noticed_at_once(pty: Pty) -> None:
    with SerialPort(pty.path, 115200) as port:
        task = asyncio.create_task(port.pump(lambda _: None, 60.0))
        await asyncio.sleep(0.02)
        began = time.monotonic()
        pty.close()
        with pytest.raises(DeviceAbsentError, match=r"unplugged \(.*\): plug it in again"):
            await task
        assert time.monotonic() - began < 0.5
        with pytest.raises(DeviceLostError):
            await port.write(b"x")
        with pytest.raises(DeviceLostError):
            await port.receive(1.0)


@pytest.mark.parametrize("key", ["port", "channel"])
def test_an_absent_port_is_named_with_its_key(tmp_path: Path, key: str) -> None:
    path = str(tmp_path / "ttyS9")
    with pytest.raises(DeviceAbsentError) as caught, SerialPort(path, 115200, key):
        pass
    assert str(caught.value).startswith(f"{path}: is not there: plug it in, or set `{key}` to ")
    assert "SLCAN" not in str(caught.value)


@pytest.mark.parametrize("bug", [ZeroDivisionError, TimeoutError, BlockingIOError, OSError])
async def test_a_bug_in_the_callback_reaches_the_caller_as_it_is(
    pty: Pty, bug: type[Exception]
) -> None:
    def emit(_: Chunk) -> None:
        raise bug

    with SerialPort(pty.path, 115200) as port:
        os.write(pty.master, b"x")
        with pytest.raises(bug) as caught:
            await port.pump(emit, 1.0)
    assert caught.type is bug


async def test_receive_returns_a_chunk_or_none(pty: Pty) -> None:
    with SerialPort(pty.path, 115200) as port:
        assert await port.receive(0.01) is None
        os.write(pty.master, b"one")
        chunk = await port.receive(1.0)
        assert chunk is not None
        assert chunk.data == b"one"
        os.write(pty.master, b"two")
        await asyncio.sleep(0.02)  # the bytes wait in the kernel
        chunk = await port.receive(1.0)
        assert chunk is not None
        assert chunk.data == b"two"


async def test_flushing_discards_old_bytes(pty: Pty) -> None:
    with SerialPort(pty.path, 115200) as port:
        os.write(pty.master, b"old")
        port.flush_input()
        os.write(pty.master, b"new")
        chunk = await port.receive(1.0)
    assert chunk is not None
    assert chunk.data == b"new"


async def test_a_write_longer_than_the_buffer_arrives_whole(pty: Pty) -> None:
    data = bytes(range(256)) * 400
    got = bytearray()
    with SerialPort(pty.path, 115200) as port:
        task = asyncio.create_task(port.write(data))
        while len(got) < len(data):
            await asyncio.sleep(0.001)
            os.set_blocking(pty.master, False)
            try:
                got += os.read(pty.master, 65536)
            except BlockingIOError:
                continue
        await task
    assert bytes(got) == data


async def test_a_port_that_takes_no_byte_is_lost(pty: Pty, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("jointfit_drivers.ports.serial_port._WRITE_TIMEOUT_S", 0.1)
    with (
        SerialPort(pty.path, 115200) as port,
        pytest.raises(DeviceLostError, match="accepted no byte"),
    ):
        await port.write(bytes(1_000_000))


def test_a_port_that_is_not_there_may_come_back(tmp_path: Path) -> None:
    with (
        pytest.raises(DeviceLostError, match="not there"),
        SerialPort(str(tmp_path / "gone"), 9600),
    ):
        pass


def test_a_taken_port_may_become_free(pty: Pty) -> None:
    with (
        SerialPort(pty.path, 115200),
        pytest.raises(DeviceLostError, match="another program"),
        SerialPort(pty.path, 115200),
    ):
        pass


def test_regular_file_is_rejected_as_a_port(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with (
        pytest.raises(DeviceMisconfiguredError, match="not a serial port"),
        SerialPort(str(tmp_path / "file"), 9600),
    ):
        pass
    with pytest.raises(DeviceMisconfiguredError), SerialPort(str(tmp_path), 9600):
        pass


def test_a_forbidden_port_names_the_group_and_the_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("serial.Serial", refuse)
    with (
        pytest.raises(DeviceLostError, match=r"dialout.*udev"),
        SerialPort("/dev/ttyUSB0", 9600),
    ):
        pass


@pytest.mark.parametrize(
    "number",
    [errno.EMFILE, errno.ENFILE, errno.EPROTO, errno.ETIMEDOUT, errno.ENOMEM, errno.ESHUTDOWN],
)
@pytest.mark.parametrize("kind", [OSError, termios.error, serial.SerialException])
def test_an_error_of_system_or_hardware_may_be_temporary(
    number: int, kind: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise kind(number, "as the kernel has it")

    monkeypatch.setattr("serial.Serial", refuse)
    with pytest.raises(DeviceLostError, match="/dev/ttyUSB0"), SerialPort("/dev/ttyUSB0", 9600):
        pass


def test_the_descriptor_is_closed_on_the_way_out(pty: Pty) -> None:
    """The end of the block closes the port, also after an exception."""
    before = len(list(Path("/proc/self/fd").iterdir()))
    with SerialPort(pty.path, 115200):
        pass
    with pytest.raises(ZeroDivisionError), SerialPort(pty.path, 115200):
        raise ZeroDivisionError
    assert len(list(Path("/proc/self/fd").iterdir())) == before
