"""The log as systemd's journal takes it: with fields, so that it can be asked for one sensor.

Law: fields name what a line is about and repeat nothing secret; whatever the journal does not take
goes to standard error instead, with its level. Protocol: datagrams of fields to journald's socket,
https://systemd.io/JOURNAL_NATIVE_PROTOCOL.
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
from jointfit_daemon.outputs.log._rate_limit import BURST, RATE_HZ, RateLimitedHandler, TokenBucket

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping
    from typing import TextIO

SOCKET = "/run/systemd/journal/socket"
FIELDS = "journal"
"""Name of a log record's extra mapping of fields: ``extra={FIELDS: about(...)}``."""
_LEVELS = {"CRITICAL": 2, "ERROR": 3, "WARNING": 4, "INFO": 6, "DEBUG": 7}
_INFO = 6


def about(kind: str, name: str) -> dict[str, dict[str, str]]:
    """Return the ``extra`` of a log line on something of the rig.

    Parameters
    ----------
    kind
        What it is about, as in ``bridge/event``: ``device``, ``calibration`` …
    name
        Id of the device, or what else it is about.
    """
    return {FIELDS: {"JOINTFIT_KIND": printable(kind), "JOINTFIT_ID": printable(name)}}


def is_journal(stream: TextIO) -> bool:
    """Return whether systemd connected `stream` to the journal: $JOURNAL_STREAM names its inode."""
    device, _, inode = os.environ.get("JOURNAL_STREAM", "").partition(":")
    try:
        found = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return (device, inode) == (str(found.st_dev), str(found.st_ino))


def datagram(fields: Mapping[str, str]) -> bytes:
    """Return `fields` as journald reads them: with its length where a value has line ends."""
    parts = []
    for name, value in fields.items():
        data = value.encode(errors="replace")
        if b"\n" in data:
            parts += [name.encode(), b"\n", struct.pack("<Q", len(data)), data, b"\n"]
        else:
            parts += [name.encode(), b"=", data, b"\n"]
    return b"".join(parts)


class LevelFormatter(logging.Formatter):
    """Prefixes every line with its level, as sd-daemon(3) has it; the journal has the time."""

    def __init__(self) -> None:
        super().__init__("%(name)s: %(message)s")

    def format(self, record: logging.LogRecord) -> str:  # type: ignore[explicit-override]  # Python 3.12's
        """Return the record as the journal reads it from standard error."""
        level = _LEVELS.get(record.levelname, _INFO)
        return "\n".join(f"<{level}>{line}" for line in super().format(record).splitlines())


class JournalHandler(RateLimitedHandler):
    """Writes to the journal, at a bounded rate.

    Parameters
    ----------
    rig
        Its name is a field of every line.
    limited
        Whether a flood is cut.
    address
        Where journald listens.
    stream, clock
        As ``RateLimitedHandler`` has them.
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
        self._socket.setblocking(False)  # a journal that hangs must not stop the loop

    @override
    def put(self, record: logging.LogRecord) -> None:
        """Hand one record to journald, or to standard error where it takes none."""
        try:
            self._socket.sendto(datagram(self._fields(record)), self._address)
        except OSError:  # away, full, or the line is longer than a datagram
            super().put(record)

    @override
    def close(self) -> None:
        """Release the socket."""
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
