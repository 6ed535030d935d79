"""Unread bytes of simulated serial ports.

If a simulated pseudo-terminal (pty) is closed, its unread bytes are lost. A real device that stops
sending loses no bytes, and a busy host reads them later. The simulator therefore waits before it
closes a port.
"""

from __future__ import annotations

import asyncio
import fcntl
import os
import struct
import termios
import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

_INTERVAL_S = 0.02
_IDLE_S = 0.3
"""If no byte is unread for this time, the hosts have read all bytes, s. The kernel delivers bytes
in blocks of 4 KB, and between two blocks the number of unread bytes can be 0."""
_STALLED_S = 2.0
"""If the number of unread bytes does not change for this time, no host reads, s."""
_MOST_S = 6.0
"""Longest wait, s. Without this limit, a host that polls its device would delay the end forever."""


async def wait_until_read(links: Iterable[Path]) -> None:
    """Wait until the hosts have read all bytes of their ports, or no host reads.

    Parameters
    ----------
    links
        Symbolic links to the hosts' ends. Links to other files than serial ports are ignored.
    """
    ports = tuple(links)
    unread = _unread(ports)
    began_s = changed_s = now_s = time.monotonic()
    while now_s - began_s < _MOST_S:
        if now_s - changed_s > (_STALLED_S if any(unread) else _IDLE_S):
            break
        await asyncio.sleep(_INTERVAL_S)
        before, unread, now_s = unread, _unread(ports), time.monotonic()
        if unread != before:
            changed_s = now_s


def _unread(ports: Iterable[Path]) -> list[int]:
    """Return the number of unread bytes of each port; 0 if a port cannot be opened."""
    return [_unread_bytes(port) for port in ports]


def _unread_bytes(link: Path) -> int:
    try:
        port = os.open(link, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:  # the port is unplugged, or is the channel of a real bus
        return 0
    try:
        size: int = struct.unpack("i", fcntl.ioctl(port, termios.FIONREAD, bytes(4)))[0]
    finally:
        os.close(port)
    return size
