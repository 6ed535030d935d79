"""Serial ports. pyserial opens and configures them; the event loop reads and writes them.

The kernel does not stamp data of a tty. Bytes are stamped with the monotonic clock immediately
after the read.

Invariant: no exception of pyserial leaves this module. A fault that may end without a change of the
settings raises `DeviceLostError`. Any other fault raises `DeviceMisconfiguredError`.
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

from jointfit_daemon.driver import DeviceAbsentError, DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk
from jointfit_drivers.ports._silence_timer import SilenceTimer

if TYPE_CHECKING:
    from collections.abc import Callable

log = logging.getLogger(__name__)

_READ_BYTES = 65536
"""Largest number of bytes per read. The buffer of a tty holds at most 4095 bytes, so one read
empties it."""
_PORT_ERRORS = (serial.SerialException, termios.error, OSError, ValueError)
"""Exceptions that pyserial raises for a port or a speed that cannot be used."""
_WRITE_TIMEOUT_S = 2.0
"""Longest wait while the port accepts no bytes, s. At 9600 baud, 100 bytes take 0.1 s."""

_NOT_A_PORT = frozenset(
    {errno.ENOTTY, errno.EINVAL, errno.EISDIR, errno.ENOTDIR, errno.ELOOP, errno.ENAMETOOLONG}
)
"""Error numbers of a file that is not a terminal. All other numbers concern the system or the
hardware."""

_LOST: dict[int, str] = {
    errno.ENOENT: "is not there",
    errno.ENODEV: "no longer exists",
    errno.ENXIO: "no longer exists",
    errno.EIO: "returns an input/output error",
    errno.EAGAIN: "is used by another program",
    errno.EBUSY: "is used by another program",
    errno.EACCES: "cannot be opened by this user (permission denied)",
    errno.EPERM: "cannot be opened by this user (permission denied)",
    errno.EMFILE: "cannot be opened: this process has no file descriptor left",
    errno.ENFILE: "cannot be opened: this host has no file descriptor left",
    errno.EPROTO: "returns a USB protocol error",
    errno.ETIMEDOUT: "does not answer the USB host in time",
}
"""Texts of common errors that may end without a change of the settings. EACCES is one of them,
because a port that has just been plugged in exists before udev has set its group."""

_ABSENT = frozenset({errno.ENOENT, errno.ENODEV, errno.ENXIO})
"""Error numbers that mean that the port is unplugged."""


class SerialPort:
    """One serial port (8N1, raw, exclusive), which is open inside its ``with`` block.

    Parameters
    ----------
    path : str
        Device file, preferably a link under ``/dev/serial/by-id``.
    baud : int
        Line speed, bit/s.
    key : str
        Key of rig.toml that contains `path`, for error messages.

    Raises
    ------
    DeviceLostError
        On entry: the port is absent, in use, or not (yet) permitted. Later: the port is unplugged
        or silent, or accepts no bytes.
    DeviceMisconfiguredError
        On entry: the file is not a serial port, or the port does not support the speed.
    """

    def __init__(self, path: str, baud: int, key: str = "port") -> None:
        self.path = path
        self._baud, self._key = baud, key
        self._port: serial.Serial | None = None

    def __enter__(self) -> Self:
        try:
            self._port = serial.Serial(self.path, self._baud, timeout=0, exclusive=True)
        except _PORT_ERRORS as error:
            raise _device_error(self.path, self._baud, error, self._key) from error

        os.set_blocking(self._fd, False)
        try:
            self._port.set_low_latency_mode(True)
        except (ValueError, NotImplementedError, AttributeError, OSError) as error:
            # Pseudoterminals and some adapters do not support this mode.
            log.debug("%s: no low-latency mode: %s", self.path, error)
        return self

    def __exit__(self, *_: object) -> None:
        port, self._port = self._port, None
        if port is None:
            return

        with suppress(termios.error, OSError):  # otherwise close waits up to 30 s for a stuck line
            termios.tcflush(port.fileno(), termios.TCOFLUSH)
        with suppress(OSError):
            port.close()

    @property
    def _fd(self) -> int:
        if self._port is None:
            raise ValueError(f"{self.path}: is not open: use it inside its `with` block")
        return int(self._port.fileno())

    def set_baud(self, baud: int) -> None:
        """Change the line speed.

        Raises
        ------
        DeviceMisconfiguredError
            The port does not support the speed.
        DeviceLostError
            The port no longer exists.
        """
        if self._port is None:
            raise ValueError(f"{self.path}: is not open: use it inside its `with` block")
        try:
            self._port.baudrate = baud
        except _PORT_ERRORS as error:
            raise _device_error(self.path, baud, error, self._key) from error
        self._baud = baud

    def flush_input(self) -> None:
        """Discard unread bytes in the system's buffer, because they may be minutes old."""
        try:
            termios.tcflush(self._fd, termios.TCIFLUSH)
        except termios.error as error:
            raise _unplugged_error(self.path, error.args[-1]) from error

    async def pump(self, emit: Callable[[Chunk], None], silence_s: float | None) -> None:
        """Pass every chunk to `emit` until cancelled.

        Parameters
        ----------
        emit : callable
            Function that is called in the event loop with each chunk. If it raises an exception,
            the pump ends and raises this exception.
        silence_s : float, optional
            Time without a byte after which the device counts as lost, s; None waits without limit.

        Raises
        ------
        DeviceLostError
            The port was unplugged, or was silent for `silence_s`.
        """
        loop = asyncio.get_running_loop()
        ended: asyncio.Future[None] = loop.create_future()  # a result means silence

        def end_silent() -> None:
            if not ended.done():
                ended.set_result(None)

        timer = None if silence_s is None else SilenceTimer(silence_s, end_silent)

        def take(chunk: Chunk) -> None:
            emit(chunk)
            if timer is not None:
                timer.note_arrival()

        try:
            loop.add_reader(self._fd, self._reader(take, ended))
            await ended
            raise DeviceLostError(
                f"{self.path}: silent for {silence_s:g} s: check power and cable, and `baud`"
            )
        finally:
            if timer is not None:
                timer.cancel()
            loop.remove_reader(self._fd)
            if ended.done() and not ended.cancelled():
                ended.exception()  # otherwise asyncio logs it after a cancellation

    async def receive(self, timeout_s: float) -> Chunk | None:
        """Return the next chunk; None if no byte arrives within `timeout_s` seconds.

        Use this method for handshakes, before `pump`. Bytes that arrive between two calls stay in
        the system's buffer.

        Raises
        ------
        DeviceLostError
            The port was unplugged.
        """
        loop = asyncio.get_running_loop()
        arrived: asyncio.Future[Chunk] = loop.create_future()

        def take(chunk: Chunk) -> None:
            loop.remove_reader(self._fd)  # later bytes are for the next call
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
        """Return a loop callback that reads and stamps a chunk; its errors are set in `ended`."""
        loop, fd, path = asyncio.get_running_loop(), self._fd, self.path
        read, now_ns = os.read, time.monotonic_ns

        def readable() -> None:
            try:
                try:
                    data = read(fd, _READ_BYTES)
                except BlockingIOError:
                    return
                except OSError as error:
                    raise _unplugged_error(path, error.strerror) from error
                if not data:  # end of file: the system has closed the port
                    raise _unplugged_error(path, "hang-up")  # noqa: TRY301 - a call costs 10 % of a read

                # The stamp must follow the read. A stamp from before the read would be too early
                # for bytes that arrive while this process is delayed, and clocks are fitted to the
                # earliest arrivals.
                take(Chunk(now_ns(), data))
            except Exception as error:  # noqa: BLE001 - a loop callback's error would only be logged
                loop.remove_reader(fd)  # a hung-up tty stays readable: 100 % CPU
                if not ended.done():
                    ended.set_exception(error)

        return readable

    async def write(self, data: bytes) -> None:
        """Write all of `data`, and wait while the port accepts no bytes.

        Raises
        ------
        DeviceLostError
            The port was unplugged, or accepted no byte for 2 s.
        """
        loop = asyncio.get_running_loop()
        fd, rest = self._fd, memoryview(data)
        while rest:
            try:
                rest = rest[os.write(fd, rest) :]
            except BlockingIOError:
                ready = asyncio.Event()
                loop.add_writer(fd, ready.set)
                try:
                    async with asyncio.timeout(_WRITE_TIMEOUT_S):
                        await ready.wait()
                except TimeoutError as error:
                    raise DeviceLostError(
                        f"{self.path}: accepted no byte for {_WRITE_TIMEOUT_S:g} s: check its "
                        "cable, and that flow control is off, or plug it in again"
                    ) from error
                finally:
                    loop.remove_writer(fd)
            except OSError as error:
                raise _unplugged_error(self.path, error.strerror) from error


def _unplugged_error(path: str, found: object) -> DeviceAbsentError:
    return DeviceAbsentError(f"{path}: unplugged ({found}): plug it in again, or check its cable")


def _device_error(
    path: str, baud: int, error: Exception, key: str
) -> DeviceLostError | DeviceMisconfiguredError:
    """Return the error to raise, with object, finding, expectation and remedy."""
    number = _error_number(error)
    if number is not None and number not in _NOT_A_PORT:
        found = _LOST.get(number, f"cannot be opened ({os.strerror(number)})")
        kind = DeviceAbsentError if number in _ABSENT else DeviceLostError
        return kind(f"{path}: {found}{_remedy(path, number, key)}")

    if isinstance(error, ValueError):  # pyserial raises it if the port refuses the speed
        return DeviceMisconfiguredError(
            f"{path}: cannot run at {baud} baud: set `baud` to a speed that port and device share"
        )
    return DeviceMisconfiguredError(
        f"{path}: not a serial port ({error}): set `{key}` to a tty, preferably one in "
        "/dev/serial/by-id"
    )


def _error_number(error: BaseException | None) -> int | None:
    """Return the error number of `error`; pyserial hides the number of termios in the context."""
    while error is not None:
        number = getattr(error, "errno", None)
        if isinstance(error, termios.error) and error.args:
            number = error.args[0]
        if isinstance(number, int):
            return number
        error = error.__context__
    return None


def _remedy(path: str, number: int, key: str) -> str:
    """Return the remedy for a port that cannot be opened."""
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
        existing = f"an existing one: {there}" if there else "its name (/dev/serial/by-id is empty)"
        return f": plug it in, or set `{key}` to {existing}"

    if number in {errno.EMFILE, errno.ENFILE}:
        return ": raise LimitNOFILE (`ulimit -n`) or find the program that keeps files open"
    return ": check the cable"
