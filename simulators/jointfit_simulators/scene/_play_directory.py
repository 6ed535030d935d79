"""Lock and stored command port in the directory of a simulation.

Invariant: only one simulator process uses a directory. The operating system releases the lock when
the process ends.
"""

from __future__ import annotations

import fcntl
import os
import socket
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING

import orjson

from jointfit_simulators.devices import LOOPBACK

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

STATE_FILE = ".jointfit-sim.json"
"""Name of the lock file. It contains ``{"pid": …, "command_port": …}`` for the next run."""
_LARGEST = 1000
"""Maximum number of bytes that are read from the lock file. This module writes fewer bytes."""
_PORTS = range(1, 65536)


class DirectoryInUseError(ValueError):
    """Another simulator uses the directory. The message names its process."""


class PortInUseError(ValueError):
    """The requested command port cannot be opened."""


class PlayDirectory:
    """A simulation directory that this process has locked."""

    def __init__(self, path: Path, file: int) -> None:
        self._path, self._file = path, file
        self._before = _state(file)

    def command_port(self, asked: int | None) -> int:
        """Return the command port for the motion-capture server; 0 selects a free port.

        Without a requested port, the function returns the port of the previous run in this
        directory if it is free. A running daemon can then reconnect to the server.

        Raises
        ------
        PortInUseError
            `asked` is in use or outside 1 to 65535.
        """
        if asked is not None:
            if asked not in _PORTS:
                raise PortInUseError(f"--command-port {asked}: expected 1 to {_PORTS[-1]}")
            if why := _occupied_reason(asked):
                raise PortInUseError(
                    f"--command-port {asked}: cannot open UDP {LOOPBACK}:{asked} ({why}): select"
                    f" another, or stop the program that uses it (ss -ulnp 'sport = {asked}')"
                )
            return asked

        before = self._before.get("command_port")
        if isinstance(before, int) and before in _PORTS and not _occupied_reason(before):
            return before
        return 0

    def store_command_port(self, command_port: int | None) -> None:
        """Store the port for the next run; None leaves the stored port unchanged."""
        stored = self._before.get("command_port") if command_port is None else command_port
        os.ftruncate(self._file, 0)
        os.pwrite(self._file, orjson.dumps({"pid": os.getpid(), "command_port": stored}), 0)


@contextmanager
def play_directory(path: Path) -> Iterator[PlayDirectory]:
    """Create the directory, and yield it locked during the ``with`` block.

    Raises
    ------
    DirectoryInUseError
        Another process has locked the directory.
    """
    path.mkdir(parents=True, exist_ok=True)
    file = os.open(path / STATE_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    try:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pid = _state(file).get("pid", "unknown")
            raise DirectoryInUseError(
                f"{path}: another simulator (process {pid}) uses this directory: stop it"
                f" (kill {pid}), or select another --directory"
            ) from None

        directory = PlayDirectory(path, file)
        directory.store_command_port(None)
        yield directory
    finally:
        os.close(file)


def _state(file: int) -> dict[str, object]:
    with suppress(orjson.JSONDecodeError):
        found = orjson.loads(os.pread(file, _LARGEST, 0))
        if isinstance(found, dict):
            return found
    return {}


def _occupied_reason(port: int) -> str | None:
    """Return the reason why `port` cannot be bound, or None."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.bind((LOOPBACK, port))
        except OSError as error:
            return error.strerror
    return None
