"""First opening of a simulated serial port by a host.

The bytes of a serial device without a reader are lost, but a pty stores them for the first reader,
which discards an unknown part of them. A device that sends without being asked therefore begins
when its port has been opened, as boards do that DTR restarts: every sample that counts as sent then
reaches the reader.
"""

from __future__ import annotations

import os
import termios
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

RESTART_S = 0.2
"""Time from the opening to the first sample, s: longer than a host discards old input."""
_CONTROL_MODES = 2
"""Index of the control modes in the result of tcgetattr."""


class OpenedPort:
    """Whether a host has opened a port for the first time.

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
        """Return whether a program set the modes of a local line, as all serial libraries do."""
        try:
            port = os.open(self._link, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:  # unplugged
            return False
        try:
            return bool(termios.tcgetattr(port)[_CONTROL_MODES] & termios.CLOCAL)
        finally:
            os.close(port)
