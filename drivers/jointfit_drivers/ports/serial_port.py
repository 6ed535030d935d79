"""Serial ports: opened and configured by pyserial, read and written by the event loop.

Law: this is the only module that knows pyserial, and nothing of pyserial leaves it: whatever goes
wrong becomes ``DeviceLostError`` (may heal) or ``DeviceMisconfiguredError`` (cannot). Bytes are
stamped with
the monotonic clock as soon as they are read, before anything else happens to them, for a tty has no
kernel stamp. No device and no protocol is named here.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import termios
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import serial

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import TracebackType

log = logging.getLogger(__name__)

_READ_BYTES = 65536  # more than any tty buffer holds (4095), so one read empties it
_WRITE_TIMEOUT_S = 2.0  # 100 bytes at 9600 baud take 0.1 s; a port that takes longer is stuck

_NOT_A_PORT = frozenset(
    {errno.ENOTTY, errno.EINVAL, errno.EISDIR, errno.ENOTDIR, errno.ELOOP, errno.ENAMETOOLONG}
)
"""What a file that is no terminal gives. Any other error is of the system or the hardware."""

_LOST: dict[int, str] = {
    errno.ENOENT: "is not there",
    errno.ENODEV: "is gone",
    errno.ENXIO: "is gone",
    errno.EIO: "gives an input/output error",
    errno.EAGAIN: "is used by another program",
    errno.EBUSY: "is used by another program",
    errno.EACCES: "may not be opened by this user",
    errno.EPERM: "may not be opened by this user",
    errno.EMFILE: "cannot be opened: this process has no file descriptor left",
    errno.ENFILE: "cannot be opened: this host has no file descriptor left",
    errno.EPROTO: "gives a USB protocol error",
    errno.ETIMEDOUT: "does not answer the USB host in time",
}
"""Common errors in words. All may pass by themselves, even EACCES: a re-plugged port exists before
udev has set its group."""


class SerialPort:
    """One serial port, 8N1, raw, exclusive, while the ``with`` block lasts.

    Parameters
    ----------
    path
        Device file, best a link under ``/dev/serial/by-id``.
    baud
        Speed, bit/s.

    Raises
    ------
    DeviceLostError
        On entry: absent, taken or not permitted (yet). Later: unplugged or silent.
    DeviceMisconfiguredError
        On entry: not a serial port, or a speed it cannot run at.
    """

    def __init__(self, path: str, baud: int) -> None:
        self.path = path
        self._baud = baud
        self._port: serial.Serial | None = None

    def __enter__(self) -> Self:
        self._port = _opened(self.path, self._baud)
        os.set_blocking(self._fd, False)
        try:
            self._port.set_low_latency_mode(True)
        except (ValueError, NotImplementedError, AttributeError, OSError) as error:
            log.debug("%s: no low-latency mode: %s", self.path, error)  # ptys, some adapters
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        port, self._port = self._port, None
        if port is None:
            return
        with suppress(termios.error, OSError):  # else close waits up to 30 s for a stuck line
            termios.tcflush(port.fileno(), termios.TCOFLUSH)
        with suppress(OSError):
            port.close()

    @property
    def baud(self) -> int:
        """Speed the port runs at, bit/s."""
        return self._baud

    @property
    def _fd(self) -> int:
        if self._port is None:
            raise ValueError(f"{self.path}: used outside its with block")
        return int(self._port.fileno())

    def set_baud(self, baud: int) -> None:
        """Run at another speed from now on.

        Raises
        ------
        DeviceMisconfiguredError
            The port cannot run at it.
        DeviceLostError
            The port is gone.
        """
        if self._port is None:
            raise ValueError(f"{self.path}: used outside its with block")
        try:
            self._port.baudrate = baud
        except (serial.SerialException, termios.error, OSError, ValueError) as error:
            raise _typed(self.path, baud, error) from error
        self._baud = baud

    def flush_input(self) -> None:
        """Throw away what the system holds unread: it may be minutes old."""
        try:
            termios.tcflush(self._fd, termios.TCIFLUSH)
        except termios.error as error:
            raise DeviceLostError(f"{self.path}: unplugged ({error.args[-1]})") from error

    async def pump(self, emit: Callable[[Chunk], None], silence_s: float | None) -> None:
        """Hand every chunk to `emit` until cancelled.

        Parameters
        ----------
        emit
            Called from the event loop with each chunk. What it raises ends the pump and reaches
            the caller.
        silence_s
            No byte for this long is a lost device, s; None waits for ever.

        Raises
        ------
        DeviceLostError
            Unplugged, or silent for `silence_s`.
        """
        loop = asyncio.get_running_loop()
        ended: asyncio.Future[None] = loop.create_future()
        limit = asyncio.timeout(silence_s)

        def take(chunk: Chunk) -> None:
            emit(chunk)
            if silence_s is not None and not limit.expired():
                limit.reschedule(loop.time() + silence_s)

        try:
            async with limit:
                loop.add_reader(self._fd, self._reader(take, ended))
                await ended
        except TimeoutError as error:
            if not limit.expired():  # raised by emit: a bug, not silence
                raise
            raise DeviceLostError(f"{self.path}: silent for {silence_s:g} s") from error
        finally:
            loop.remove_reader(self._fd)
            if ended.done() and not ended.cancelled():
                ended.exception()  # seen, should a cancellation have overtaken it

    async def receive(self, timeout_s: float) -> Chunk | None:
        """Return the next chunk, or None if nothing came in `timeout_s` seconds.

        For handshakes, before ``pump``: what arrives between two calls waits in the system and is
        not lost.

        Raises
        ------
        DeviceLostError
            Unplugged.
        """
        loop = asyncio.get_running_loop()
        arrived: asyncio.Future[Chunk] = loop.create_future()

        def take(chunk: Chunk) -> None:
            loop.remove_reader(self._fd)  # one chunk; the rest waits for the next call
            if not arrived.done():
                arrived.set_result(chunk)

        try:
            async with asyncio.timeout(timeout_s):
                loop.add_reader(self._fd, self._reader(take, arrived))
                return await arrived
        except TimeoutError:
            return None
        finally:
            loop.remove_reader(self._fd)

    def _reader(
        self, take: Callable[[Chunk], None], ended: asyncio.Future[Any]
    ) -> Callable[[], None]:
        """Return a loop callback that stamps, reads and hands on; its errors go to `ended`."""
        loop, fd = asyncio.get_running_loop(), self._fd

        def readable() -> None:
            try:
                data = self._read(fd)
                # A tty has no kernel stamp. Not before the read: bytes that come while this process
                # is held up between the two would be stamped early, and no clock forgives that.
                t_ns = time.monotonic_ns()
                if data is not None:
                    take(Chunk(t_ns, data))
            except Exception as error:  # noqa: BLE001 - a loop callback's error would only be logged
                loop.remove_reader(fd)  # a hung-up tty stays readable: 100 % CPU
                if not ended.done():
                    ended.set_exception(error)

        return readable

    async def write(self, data: bytes) -> None:
        """Write all of `data`, waiting where the port is full.

        Raises
        ------
        DeviceLostError
            Unplugged, or the port takes no byte for 2 s.
        """
        fd, rest = self._fd, memoryview(data)
        while rest:
            try:
                rest = rest[os.write(fd, rest) :]
            except BlockingIOError:
                await self._writable(fd)
            except OSError as error:
                raise DeviceLostError(f"{self.path}: unplugged ({error.strerror})") from error

    async def _writable(self, fd: int) -> None:
        """Wait until the port takes bytes again."""
        loop = asyncio.get_running_loop()
        ready = asyncio.Event()
        loop.add_writer(fd, ready.set)
        try:
            async with asyncio.timeout(_WRITE_TIMEOUT_S):
                await ready.wait()
        except TimeoutError as error:
            raise DeviceLostError(
                f"{self.path}: takes no byte for {_WRITE_TIMEOUT_S:g} s"
            ) from error
        finally:
            loop.remove_writer(fd)

    def _read(self, fd: int) -> bytes | None:
        """Return what is there; None if the wake-up was for nothing.

        Raises
        ------
        DeviceLostError
            Hang-up: end of file, or an error of the port.
        """
        try:
            data = os.read(fd, _READ_BYTES)
        except BlockingIOError:
            return None
        except OSError as error:
            raise DeviceLostError(f"{self.path}: unplugged ({error.strerror})") from error
        if not data:
            raise DeviceLostError(f"{self.path}: unplugged (hang-up)")
        return data


def _opened(path: str, baud: int) -> serial.Serial:
    """Open `path`; errors as the house names them."""
    try:
        return serial.Serial(path, baud, timeout=0, exclusive=True)
    except (serial.SerialException, termios.error, OSError, ValueError) as error:
        raise _typed(path, baud, error) from error


def _typed(path: str, baud: int, error: Exception) -> DeviceLostError | DeviceMisconfiguredError:
    """Name what happened: thing, found, expected, remedy."""
    number = _errno(error)
    if number is not None and number not in _NOT_A_PORT:
        found = _LOST.get(number, f"cannot be opened ({os.strerror(number)})")
        return DeviceLostError(f"{path}: {found}{_remedy(path, number)}")
    if isinstance(error, ValueError):  # pyserial: the driver of this port refused the speed
        return DeviceMisconfiguredError(
            f"{path}: cannot run at {baud} baud: set `baud` to a speed that port and device share"
        )
    return DeviceMisconfiguredError(
        f"{path}: not a serial port ({error}): set `port` to a tty, best one of /dev/serial/by-id"
    )


def _errno(error: BaseException | None) -> int | None:
    """Return the number behind `error`: pyserial hides that of termios in the context."""
    while error is not None:
        number = getattr(error, "errno", None)
        if isinstance(error, termios.error) and error.args:
            number = error.args[0]
        if isinstance(number, int):
            return number
        error = error.__context__
    return None


def _remedy(path: str, number: int) -> str:
    """Say what to do about a port that did not open."""
    if number in {errno.EACCES, errno.EPERM}:
        return (
            ": add the user to the group dialout (usermod -aG dialout USER) "
            "and install the udev rule 70-jointfitd.rules"
        )
    if number in {errno.EAGAIN, errno.EBUSY}:
        return (
            f": stop it (`fuser {path}` names it); "
            "against ModemManager install the udev rule 70-jointfitd.rules"
        )
    if number == errno.ENOENT:
        there = ", ".join(sorted(map(str, Path("/dev/serial/by-id").glob("*"))))
        return (
            ": plug it in, or set `port` (of an SLCAN adapter: `channel`) to one that is there: "
            f"{there or '/dev/serial/by-id is empty'}"
        )
    if number in {errno.EMFILE, errno.ENFILE}:
        return ": raise LimitNOFILE (`ulimit -n`) or find the program that keeps files open"
    return ": check the cable"
