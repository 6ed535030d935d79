"""Sockets to one server, which are read in the event loop.

The event loop calls the readers, so the readers cannot raise an error in the driver's coroutine. An
error of a reader is stored. The coroutine waits in `SocketLink.pause`, which raises the error.
"""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Self


class OpenSocket(Protocol):
    """Interface of the sockets in `jointfit_drivers.ports`."""

    def fileno(self) -> int:
        """Return the file descriptor."""

    def close(self) -> None:
        """Close the socket."""


class SocketLink:
    """Sockets that are read until the link ends.

    The links of device families derive from this class.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._sockets: list[OpenSocket] = []
        self._arrived = asyncio.Event()
        self._failure: Exception | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stop_reading()
        for opened in self._sockets:
            opened.close()

    def watch(self, opened: OpenSocket, read: Callable[[], None]) -> None:
        """Call `read` whenever data arrive at a socket. The link closes the socket at its end."""
        self._sockets.append(opened)
        self._loop.add_reader(opened, self._call, read)

    def wake(self) -> None:
        """End the current `pause`, because a message arrived."""
        self._arrived.set()

    def fail(self, error: Exception) -> None:
        """Make `pause` raise `error`, unless an earlier error is already stored."""
        self._failure = self._failure or error
        self._arrived.set()

    async def pause(self, seconds: float) -> None:
        """Wait until `wake` is called, but at most `seconds`; raise errors of the readers."""
        if seconds > 0 and self._failure is None:
            with suppress(TimeoutError):
                async with asyncio.timeout(seconds):
                    await self._arrived.wait()
        self._arrived.clear()
        if self._failure is not None:
            raise self._failure

    def _call(self, read: Callable[[], None]) -> None:
        try:
            read()
        except Exception as error:  # noqa: BLE001 - a callback passes its error to the coroutine
            self._stop_reading()
            self.fail(error)

    def _stop_reading(self) -> None:
        for opened in self._sockets:
            self._loop.remove_reader(opened)
