"""Bytes of simulated serial ports that their hosts have not read yet.

Closing a pty discards them, whereas a real device that falls silent loses nothing: a host that is
behind, as on a busy machine, reads them later.
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
"""Time without unread bytes after which all is read, s: the kernel delivers in pieces of 4 KB."""
_STALLED_S = 2.0
"""Time without change after which nobody reads, s."""
_MOST_S = 6.0
"""Longest wait, s: a host that polls its device is answered without end."""


async def wait_until_read(links: Iterable[Path]) -> None:
    """Wait until the hosts have read all bytes of their ports, or none reads any more.

    Parameters
    ----------
    links
        Symbolic links to the hosts' ends; those that are no serial port are left out.
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
    """Return the number of unread bytes of each port; 0 for one that cannot be opened."""
    return [_unread_bytes(port) for port in ports]


def _unread_bytes(link: Path) -> int:
    try:
        port = os.open(link, os.O_RDONLY | os.O_NOCTTY | os.O_NONBLOCK)
    except OSError:  # unplugged, or the channel of a real bus
        return 0
    try:
        size: int = struct.unpack("i", fcntl.ioctl(port, termios.FIONREAD, bytes(4)))[0]
    finally:
        os.close(port)
    return size
