"""Opening of python-can buses in a thread with a time limit, and a check of a CAN server.

Vendor libraries may wait without limit, and a call of a library cannot be interrupted. python-can
repeats the attempt to connect to a socketcand server in a loop without pauses, and waits for the
server's greeting without limit.

Invariant: each bus is opened by at most one thread at a time, and no such thread delays the end of
the process.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from concurrent.futures import Future, InvalidStateError
from contextlib import suppress
from typing import TYPE_CHECKING, Protocol, TypeVar

from jointfit_daemon.driver import DeviceLostError

if TYPE_CHECKING:
    from collections.abc import Callable


class _Closable(Protocol):
    def shutdown(self) -> None: ...


_Bus = TypeVar("_Bus", bound=_Closable)

OPEN_S = 5.0
"""Longest time for the opening of a bus, s. Vendor libraries need one or two seconds."""
_SERVER_S = 1.5
"""Longest wait for the connection to a server, and for each answer, s."""
_GREETING, _OPENED = "< hi >", "< ok >"
"""Texts that a socketcand server sends: its greeting, and its answer after it opened a bus."""
_LONGEST = 40
"""Largest number of bytes of an answer that are read. The error message contains these bytes, so
that a user can recognize another type of server."""

_opening: set[str] = set()
"""Keys of the buses that a thread is currently opening."""


async def open_in_thread(key: str, name: str, make: Callable[[], _Bus]) -> _Bus:
    """Return the bus that `make` opens within `OPEN_S`.

    If `make` opens the bus after the limit or after a cancellation, its thread closes the bus.

    Parameters
    ----------
    key : str
        Key that identifies the bus in all calls.
    name : str
        Name of the bus in messages.
    make : callable
        Function that opens the bus; it runs in a separate thread.

    Raises
    ------
    DeviceLostError
        The bus was not opened within the limit, or an earlier call for this bus is still running.
    Exception
        Any exception that `make` raises.
    """
    too_long = DeviceLostError(
        f"{name}: not opened within {OPEN_S:g} s: restart its adapter or server, and check its "
        "[can] table; retrying as soon as the library of the bus returns"
    )
    if key in _opening:
        raise too_long

    made: Future[_Bus] = Future()
    loop, ended = asyncio.get_running_loop(), asyncio.Event()

    def wake(_: Future[_Bus]) -> None:
        with suppress(RuntimeError):  # the loop is closed
            loop.call_soon_threadsafe(ended.set)

    made.add_done_callback(wake)
    # The process does not wait for a daemon thread when it ends.
    _opening.add(key)
    run = threading.Thread(target=_make, args=(key, made, make), name=f"open {name}", daemon=True)
    run.start()
    try:
        with suppress(TimeoutError):
            async with asyncio.timeout(OPEN_S):
                await ended.wait()
        if made.cancel():  # not open yet; the thread closes the bus later
            raise too_long
    except asyncio.CancelledError:
        if not made.cancel() and made.exception() is None:
            made.result().shutdown()
        raise
    return made.result()


def _make(key: str, made: Future[_Bus], make: Callable[[], _Bus]) -> None:
    """Set the result of `made`. If no task waits for the bus any more, close it."""
    try:
        bus = make()
    except BaseException as error:  # noqa: BLE001 - handed to the task that waits
        _opening.discard(key)
        with suppress(InvalidStateError):
            made.set_exception(error)
        return

    try:
        _opening.discard(key)
        made.set_result(bus)
    except InvalidStateError:
        bus.shutdown()


def require_socketcand(channel: str, host: str, port: int) -> None:
    """Connect to a socketcand server, open `channel` on it, and disconnect.

    The check is necessary because python-can would repeat a refused connection for ten seconds
    without pauses, wait for answers without limit, and leave the connection open after a refusal.

    Raises
    ------
    DeviceLostError
        No server accepts the connection, the answering program is not socketcand, or the server
        refuses the bus.
    """
    server = f"{channel}: socketcand server {host}:{port}"
    remedy = "start socketcand there, or correct host and port in its [can] table"
    try:
        with socket.create_connection((host, port), timeout=_SERVER_S) as connection:
            greeting, opened = _receive_answer(connection), ""
            if greeting == _GREETING:
                connection.sendall(f"< open {channel} >".encode())
                opened = _receive_answer(connection)
    except TimeoutError as error:
        raise DeviceLostError(f"{server}: no answer within {_SERVER_S:g} s: {remedy}") from error
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise DeviceLostError(f"{server}: {reason}: {remedy}") from error

    if greeting != _GREETING:
        raise DeviceLostError(
            f"{server}: found {greeting!r}, expected the greeting {_GREETING!r}: {remedy}"
        )
    if opened != _OPENED:
        raise DeviceLostError(
            f"{server}: found {opened!r} after opening {channel}, expected {_OPENED!r}: start "
            f"the server for this bus (`socketcand -i {channel}`), or correct `channel`"
        )


def _receive_answer(connection: socket.socket) -> str:
    """Return the next text up to ``>``, or the text received until a disconnect or 40 bytes."""
    text = b""
    while len(text) < _LONGEST and not text.endswith(b">"):
        received = connection.recv(_LONGEST)
        if not received:
            break
        text += received
    return text[:_LONGEST].decode("ascii", "replace")
