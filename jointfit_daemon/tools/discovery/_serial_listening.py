"""Reception on one serial port, at the usual speeds of the installed drivers.

Invariant: nothing is sent, and the settings of the port are restored. The port is opened for
reading only, but the kernel raises DTR and RTS, which resets some boards.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import os
import select
import termios
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jointfit_daemon.model import Chunk
from jointfit_daemon.tools.discovery._mocap_servers import installed_drivers
from jointfit_daemon.tools.discovery._traffic import DecodedDevice, decode_stream

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from jointfit_daemon.tools.discovery._traffic import Layouts

_DEFAULT_BAUDS = (115_200,)
_READ_BYTES = 4096
_POLL_S = 0.05
_FAULTS = {
    errno.ENOENT: "is absent: plug the adapter in, or choose a port that `jointfit probe` lists",
    errno.EACCES: "permission denied: sudo usermod -aG dialout $USER, then log in again",
    errno.EPERM: "permission denied: sudo usermod -aG dialout $USER, then log in again",
    errno.EBUSY: "is used by another program: stop this program (the command fuser names it)",
    errno.ENOTTY: "is not a serial port: choose a port that `jointfit probe` lists",
    errno.EIO: "has no hardware behind it: choose a port that `jointfit probe` lists",
}


@dataclass(frozen=True, slots=True)
class SerialTraffic:
    """Result of the reception on one port."""

    port: str
    fault: str | None
    """Reason why the port cannot be opened, with a remedy; None if it could be opened."""
    received_bytes: dict[int, int]
    """Number of received bytes, by speed (baud)."""
    baud: int | None = None
    """Speed at which a driver decodes the data, baud."""
    devices: tuple[DecodedDevice, ...] = ()
    """Devices that the drivers decoded; usually one. Several drivers decode the data only if their
    formats are similar."""


def usual_bauds() -> tuple[int, ...]:
    """Return the speeds of all installed drivers of byte streams, default speeds first.

    Speeds that this system cannot set, such as 128 000 baud, are omitted.
    """
    speeds: list[tuple[int, ...]] = [
        getattr(driver, "usual_bauds", _DEFAULT_BAUDS)
        for _, driver in installed_drivers()
        if driver.wire == "stream"
    ]
    longest = max(map(len, speeds), default=0)
    # Take one speed of each driver in turn, so the default speeds precede the rare speeds.
    turns = [bauds[k] for k in range(longest) for bauds in speeds if k < len(bauds)]
    return tuple(baud for baud in dict.fromkeys(turns) if hasattr(termios, f"B{baud}"))


def listen_serial(
    port: str,
    *,
    listen_s: float = 1.5,
    bauds: Sequence[int] | None = None,
    progress: Callable[[float], None] | None = None,
    layouts: Layouts | None = None,
) -> SerialTraffic:
    """Receive on a port at one speed after another until a driver decodes the data.

    If no byte arrives at one speed, the search ends, because bytes arrive even at a wrong speed.

    Parameters
    ----------
    port
        Path of the device file, or a link to it.
    listen_s
        Time at each speed, s.
    bauds
        Speeds to try, baud; the default is `usual_bauds`.
    progress
        Callback that receives the completed share, 0 to 1.
    layouts
        Tables to try in addition to the default tables, by driver.
    """
    tried = tuple(usual_bauds() if bauds is None else bauds)
    received: dict[int, int] = {}
    try:
        with _open(port) as descriptor:
            for k, baud in enumerate(tried):
                _set_speed(descriptor, baud)
                chunks = list(_receive(descriptor, listen_s))
                received[baud] = sum(len(chunk.data) for chunk in chunks)
                if progress is not None:
                    progress((k + 1) / len(tried))
                if not received[baud]:
                    break
                devices = decode_stream(chunks, baud, layouts=layouts)
                if devices:
                    return SerialTraffic(port, None, received, baud, devices)
    except OSError as error:
        text = _FAULTS.get(error.errno or 0, f"{error.strerror or error}: check the cable")
        return SerialTraffic(port, f"{port}: {text}", received)
    return SerialTraffic(port, None, received)


@contextlib.contextmanager
def _open(port: str) -> Iterator[int]:
    """Open a port exclusively for reading; restore its settings at the end."""
    descriptor = os.open(port, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        if not os.isatty(descriptor):
            raise OSError(errno.ENOTTY, os.strerror(errno.ENOTTY))
        fcntl.ioctl(descriptor, termios.TIOCEXCL)
        before = _attributes(descriptor)
        try:
            yield descriptor
        finally:
            with contextlib.suppress(termios.error, OSError):  # the adapter was unplugged
                termios.tcsetattr(descriptor, termios.TCSANOW, before)
                fcntl.ioctl(descriptor, termios.TIOCNXCL)
    finally:
        os.close(descriptor)


def _attributes(descriptor: int) -> list[Any]:
    try:
        return termios.tcgetattr(descriptor)
    except termios.error as error:
        raise OSError(*error.args) from error


def _set_speed(descriptor: int, baud: int) -> None:
    """Set raw mode, 8N1 without flow control; discard bytes received at another speed."""
    speed = getattr(termios, f"B{baud}", None)
    if speed is None:
        raise OSError(errno.EINVAL, f"{baud} baud is not a speed of this system")
    _, _, cflag, _, _, _, characters = _attributes(descriptor)
    cflag &= ~(termios.CSIZE | termios.PARENB | termios.CSTOPB | termios.CRTSCTS)
    cflag |= termios.CS8 | termios.CREAD | termios.CLOCAL
    try:
        termios.tcsetattr(descriptor, termios.TCSANOW, [0, 0, cflag, 0, speed, speed, characters])
        termios.tcflush(descriptor, termios.TCIFLUSH)
    except termios.error as error:
        raise OSError(*error.args) from error


def _receive(descriptor: int, listen_s: float) -> Iterator[Chunk]:
    """Yield the bytes received within `listen_s`; an arrival is the time after the read call."""
    until = time.monotonic() + listen_s
    while (left := until - time.monotonic()) > 0:
        ready, _, _ = select.select([descriptor], [], [], min(left, _POLL_S))
        if ready:
            try:
                data = os.read(descriptor, _READ_BYTES)
            except BlockingIOError:
                continue
            if not data:
                raise OSError(errno.ENODEV, "unplugged")
            yield Chunk(time.monotonic_ns(), data)
