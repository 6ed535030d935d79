"""Opening of buses of python-can by a thread, within a time limit, and a check of a CAN server.

Libraries of vendors may wait without end, and no call of a library can be interrupted. python-can
connects to a socketcand server in a loop without a pause, and waits for its greeting without end.

Invariant: at most one thread per bus is opening it, and no such thread delays the end of the
process.
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
"""Longest time for an opening, s: a vendor's library takes one or two."""
_SERVER_S = 1.5
"""Longest wait for the connection to a server, and for each answer, s."""
_GREETING, _OPENED = "< hi >", "< ok >"
"""Texts of a socketcand server: the greeting, and the answer to the opening of a bus."""
_LONGEST = 40
"""Longest answer, bytes: enough to name another kind of server."""

_opening: set[str] = set()
"""Buses that a thread is opening."""


async def open_in_thread(key: str, name: str, make: Callable[[], _Bus]) -> _Bus:
    """Return the bus that `make` opens, within `OPEN_S`.

    A bus that opens after the limit, or after a cancellation, is closed again by its thread.

    Parameters
    ----------
    key : str
        Identifies the bus among all calls.
    name : str
        The bus, as named in messages.
    make : callable
        Opens the bus; runs in a thread of its own.

    Raises
    ------
    DeviceLostError
        The bus was not opened within the limit, or an earlier call for it has not ended.
    Exception
        Any exception of `make`.
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
    # A daemon thread: the process does not wait for it at its end.
    _opening.add(key)
    run = threading.Thread(target=_make, args=(key, made, make), name=f"open {name}", daemon=True)
    run.start()
    try:
        with suppress(TimeoutError):
            async with asyncio.timeout(OPEN_S):
                await ended.wait()
        if made.cancel():  # not open yet: the thread will close it
            raise too_long
    except asyncio.CancelledError:
        if not made.cancel() and made.exception() is None:
            made.result().shutdown()
        raise
    return made.result()


def _make(key: str, made: Future[_Bus], make: Callable[[], _Bus]) -> None:
    """Set the result of `made`; close a bus for which no task waits any more."""
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
    """Connect to a socketcand server, open `channel` there and disconnect.

    python-can would repeat a refused connection without pause for ten seconds, wait for answers
    without end, and leave the connection open after a refusal.

    Raises
    ------
    DeviceLostError
        No server accepts the connection, it does not answer as socketcand, or it refuses the bus.
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
            f"{server}: found {opened!r} after opening {channel}, expected {_OPENED!r}: let the "
            f"server serve it (`socketcand -i {channel}`), or correct `channel`"
        )


def _receive_answer(connection: socket.socket) -> str:
    """Return the next text up to ``>``; less after 40 bytes or at the end of the connection."""
    text = b""
    while len(text) < _LONGEST and not text.endswith(b">"):
        received = connection.recv(_LONGEST)
        if not received:
            break
        text += received
    return text[:_LONGEST].decode("ascii", "replace")
