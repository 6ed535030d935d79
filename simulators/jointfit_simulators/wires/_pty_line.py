"""Serial line based on a pseudo-terminal (pty), with a symbolic link to the host's end.

Invariant: this process keeps the host's end open, so the host can close and reopen its port. Only
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
_INPUT_SPEED = 4
"""Index of the input speed in the result of tcgetattr."""
_SPEEDS = {
    getattr(termios, f"B{baud}"): baud
    for baud in (
        4800, 9600, 19200, 38400, 57600, 115200, 230400, 460800, 500000, 576000, 921600,
        1000000, 1152000, 1500000, 2000000, 2500000, 3000000, 3500000, 4000000,
    )
    if hasattr(termios, f"B{baud}")
}  # fmt: skip


class PtyLine:
    """Serial line, which is connected from the start.

    Parameters
    ----------
    link
        Symbolic link to the host's port. An existing link is replaced.
    """

    def __init__(self, link: Path) -> None:
        self.link = link
        self._fds: tuple[int, int] | None = None  # device end, host end
        self._rest = b""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._receive: Callable[[bytes], None] = _ignore
        self._ended: asyncio.Future[None] | None = None
        self.plug()

    @property
    def host_baud(self) -> int | None:
        """Speed of the host's port, bit/s; None if unplugged or if the speed is not standard."""
        if self._fds is None:
            return None
        return _SPEEDS.get(termios.tcgetattr(self._fds[1])[_INPUT_SPEED])

    def plug(self) -> None:
        """Create the line; do nothing if it exists."""
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
        """Hang up, and remove the link; do nothing if the line is unplugged."""
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
        """Write all of `data` or nothing; return False if the line is full (no reader)."""
        if self._fds is None or not self._flush():
            return False
        self._rest = data
        self._flush()
        return True

    def _flush(self) -> bool:
        """Write the rest of an earlier message; return whether nothing remains."""
        if self._rest and self._fds is not None:
            with suppress(BlockingIOError):
                self._rest = self._rest[os.write(self._fds[0], self._rest) :]

            # The event loop writes the rest of this message, because there may be no further write.
            if self._loop is not None:
                self._loop.remove_writer(self._fds[0])
                if self._rest:
                    self._loop.add_writer(self._fds[0], self._flush)
        return not self._rest

    async def serve(self, receive: Callable[[bytes], None]) -> None:
        """Pass bytes from the host to `receive` until cancelled.

        The transfer continues after the line was unplugged and plugged in.

        Raises
        ------
        RuntimeError
            Another call already serves the line.
        """
        if self._loop is not None:
            raise RuntimeError(f"{self.link}: the line is already served")
        self._loop = asyncio.get_running_loop()
        self._receive, self._ended = receive, self._loop.create_future()
        if self._fds is not None:
            self._loop.add_reader(self._fds[0], self._readable)

        try:
            await self._ended
        finally:
            if self._fds is not None:
                self._loop.remove_reader(self._fds[0])
                self._loop.remove_writer(self._fds[0])
            self._loop, self._receive = None, _ignore

    def _readable(self) -> None:
        if self._fds is None or self._ended is None:
            return
        try:
            self._receive(os.read(self._fds[0], _READ_BYTES))
        except BlockingIOError:
            return
        except Exception as error:  # noqa: BLE001 - a loop callback's error would only be logged
            if not self._ended.done():
                self._ended.set_exception(error)


def _ignore(_: bytes) -> None:
    """Ignore bytes that arrive while no call serves the line."""
