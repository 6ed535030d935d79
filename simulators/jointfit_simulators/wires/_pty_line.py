"""Serial line based on a pty, with a symbolic link to the host's end.

Invariant: the slave stays open on this side, so the host can close and reopen its port; only
``unplug`` hangs up.
"""

from __future__ import annotations

import asyncio
import os
import termios
import tty
from contextlib import suppress
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

_READ_BYTES = 65536
_SPEED = 4  # index of the input speed in what tcgetattr returns
_SPEEDS = {
    getattr(termios, f"B{baud}"): baud
    for baud in (
        4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 500000, 576000, 921600,
        1000000, 1152000, 1500000, 2000000, 2500000, 3000000, 3500000, 4000000,
    )
    if hasattr(termios, f"B{baud}")
}  # fmt: skip


class PtyLine:
    """One line, plugged in from the start.

    Parameters
    ----------
    link
        Where the host finds its port; replaced if it is there.
    """

    def __init__(self, link: Path) -> None:
        self.link = link
        self._fds: tuple[int, int] | None = None  # device's end, host's end
        self._rest = b""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._take: Callable[[bytes], None] = _ignore
        self._ended: asyncio.Future[None] | None = None
        self.plug()

    @property
    def plugged(self) -> bool:
        """Whether the line exists."""
        return self._fds is not None

    @property
    def host_baud(self) -> int | None:
        """Speed the host set its port to, bit/s; None if unplugged or an unusual one."""
        if self._fds is None:
            return None
        return _SPEEDS.get(termios.tcgetattr(self._fds[1])[_SPEED])

    def plug(self) -> None:
        """Make the line; nothing happens if it is there."""
        if self._fds is not None:
            return
        device, host = os.openpty()
        tty.setraw(host)
        os.set_blocking(device, False)
        self._fds = (device, host)
        self.link.unlink(missing_ok=True)
        self.link.symlink_to(os.ttyname(host))
        if self._loop is not None:
            self._loop.add_reader(device, self._readable)

    def unplug(self) -> None:
        """Hang up and remove the link; nothing happens if that was done."""
        if self._fds is None:
            return
        if self._loop is not None:
            self._loop.remove_reader(self._fds[0])
            self._loop.remove_writer(self._fds[0])
        for fd in self._fds:
            os.close(fd)
        self._fds, self._rest = None, b""
        self.link.unlink(missing_ok=True)

    def write(self, data: bytes) -> bool:
        """Put `data` on the line, all or nothing: False where nobody reads and the line is full."""
        if self._fds is None or not self._flushed():
            return False
        self._rest = data
        self._flushed()
        return True

    def _flushed(self) -> bool:
        """Put what is left of an earlier write on the line; whether nothing is left."""
        if self._rest and self._fds is not None:
            with suppress(BlockingIOError):
                self._rest = self._rest[os.write(self._fds[0], self._rest) :]
            if self._loop is not None:  # the last write of all has none after it that would go on
                self._loop.remove_writer(self._fds[0])
                if self._rest:
                    self._loop.add_writer(self._fds[0], self._flushed)
        return not self._rest

    async def serve(self, take: Callable[[bytes], None]) -> None:
        """Hand what the host writes to `take` until cancelled; unplugging is survived.

        Raises
        ------
        RuntimeError
            The line is served already.
        """
        if self._loop is not None:
            raise RuntimeError(f"{self.link}: served twice")
        self._loop = asyncio.get_running_loop()
        self._take, self._ended = take, self._loop.create_future()
        if self._fds is not None:
            self._loop.add_reader(self._fds[0], self._readable)
        try:
            await self._ended
        finally:
            if self._fds is not None:
                self._loop.remove_reader(self._fds[0])
                self._loop.remove_writer(self._fds[0])
            self._loop, self._take = None, _ignore

    def _readable(self) -> None:
        if self._fds is None or self._ended is None:
            return
        try:
            self._take(os.read(self._fds[0], _READ_BYTES))
        except BlockingIOError:
            return
        except Exception as error:  # noqa: BLE001 - a loop callback's error would only be logged
            if not self._ended.done():
                self._ended.set_exception(error)


def _ignore(_: bytes) -> None:
    """Take bytes nobody waits for."""
