"""Log handler for the systemd journal. Entries have fields, so they can be filtered by sensor.

Invariant: an entry that journald does not accept is written to standard error with its log level.

Source: https://systemd.io/JOURNAL_NATIVE_PROTOCOL.
"""

from __future__ import annotations

import logging
import math
import os
import socket
import struct
import sys
import time
from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_daemon.outputs.log._printable_text import printable
from jointfit_daemon.outputs.log._rate_limit import BURST, RATE_HZ, RateLimitedHandler
from jointfit_daemon.outputs.token_bucket import TokenBucket

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import TextIO

SOCKET = "/run/systemd/journal/socket"
FIELDS = "journal"
"""Attribute of a log record that contains the additional journal fields."""
_LEVELS = {"CRITICAL": 2, "ERROR": 3, "WARNING": 4, "INFO": 6, "DEBUG": 7}
"""Syslog priorities of the levels of Python."""
_INFO = 6


def journal_fields(kind: str, name: str) -> dict[str, dict[str, str]]:
    """Return the argument ``extra`` of a log call, with the journal fields of one object.

    Parameters
    ----------
    kind
        Kind of the object, such as ``device`` or ``calibration``, as on the topic ``bridge/event``.
    name
        Id of the object.
    """
    return {FIELDS: {"JOINTFIT_KIND": printable(kind), "JOINTFIT_ID": printable(name)}}


def is_journal(stream: TextIO) -> bool:
    """Return whether `stream` writes to the journal, identified by $JOURNAL_STREAM."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return (device, inode) == (str(found.st_dev), str(found.st_ino))


def datagram(fields: Mapping[str, str]) -> bytes:
    """Return `fields` in journald's protocol; values with line ends have a length prefix."""
    parts = []
    for name, value in fields.items():
        data = value.encode(errors="replace")
        if b"\n" in data:
            parts += [name.encode(), b"\n", struct.pack("<Q", len(data)), data, b"\n"]
        else:
            parts += [name.encode(), b"=", data, b"\n"]
    return b"".join(parts)


class LevelFormatter(logging.Formatter):
    """Formatter that puts the log level before every line, as described in sd-daemon(3).

    The journal adds the time to each line.
    """

    def __init__(self) -> None:
        super().__init__("%(name)s: %(message)s")

    def format(self, record: logging.LogRecord) -> str:  # type: ignore[explicit-override]  # Python 3.12's
        """Return the record with the level prefix on each line."""
        level = _LEVELS.get(record.levelname, _INFO)
        return "\n".join(f"<{level}>{line}" for line in super().format(record).splitlines())


class JournalHandler(RateLimitedHandler):
    """Writes log records to the journal at a limited rate.

    Parameters
    ----------
    rig
        Name of the rig, which becomes a field of every entry.
    limited
        Whether the rate is limited.
    address
        Path of journald's socket.
    stream, clock
        Parameters of `RateLimitedHandler`.
    """

    def __init__(
        self,
        rig: str,
        *,
        limited: bool = True,
        address: str = SOCKET,
        stream: TextIO = sys.stderr,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        burst = BURST if limited else math.inf
        super().__init__(stream, clock, TokenBucket(RATE_HZ, burst, clock()))
        self.setFormatter(LevelFormatter())
        self._plain = logging.Formatter("%(name)s: %(message)s")
        self._rig, self._address = rig, address
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)  # a blocked journal must not block the event loop

    @override
    def put(self, record: logging.LogRecord) -> None:
        """Send one record to journald, or write it to standard error if journald refuses it."""
        try:
            self._socket.sendto(datagram(self._fields(record)), self._address)
        except OSError:  # no journald, a full socket, or an entry longer than a datagram
            super().put(record)

    @override
    def close(self) -> None:
        """Close the socket."""
        self._socket.close()
        super().close()

    def _fields(self, record: logging.LogRecord) -> dict[str, str]:
        return {
            "MESSAGE": self._plain.format(record),
            "PRIORITY": str(_LEVELS.get(record.levelname, _INFO)),
            "SYSLOG_IDENTIFIER": "jointfitd",
            "JOINTFIT_RIG": self._rig,
            "LOGGER": record.name,
            "CODE_FILE": record.pathname,
            "CODE_LINE": str(record.lineno),
            "CODE_FUNC": record.funcName or "",
            **getattr(record, FIELDS, {}),
        }
