"""Detects the first opening of a simulated serial port by a host.

Without a reader, the bytes of a real serial device are lost. A pseudo-terminal (pty) stores them
for the first reader, which discards an unknown part of them. A simulated device that sends without
a request therefore begins when its port has been opened, like a board that restarts when the host
sets DTR. Every sample that counts as sent then reaches the reader.
"""

from __future__ import annotations

import os
import termios
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

RESTART_S = 0.2
"""Time from the opening to the first sample, s. In this time, a host discards old input."""
_CONTROL_MODES = 2
"""Index of the control modes in the result of tcgetattr."""


class OpenedPort:
    """Detector of the first opening of a port by a host.

    Parameters
    ----------
    link
        Symbolic link to the host's end.
    """

    def __init__(self, link: Path) -> None:
        self._link = link
        self._opened_s: float | None = None

    @property
    def is_read(self) -> bool:
        """Whether a host opened the port at least `RESTART_S` ago."""
        if self._opened_s is None and self._is_configured():
            self._opened_s = time.monotonic()
        return self._opened_s is not None and time.monotonic() - self._opened_s > RESTART_S

    def _is_configured(self) -> bool:
        """Return whether a program has set the modes of the port, as all serial libraries do."""
        try:
            port = os.open(self._link, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:  # the port is unplugged
            return False
        try:
            return bool(termios.tcgetattr(port)[_CONTROL_MODES] & termios.CLOCAL)
        finally:
            os.close(port)
