"""Facts about this host, from files below a root folder and from a few system calls.

Invariant: everything is read without root access, and nothing is changed.
"""

from __future__ import annotations

import ctypes
import getpass
import grp
import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from jointfit_daemon.tools.discovery import RunCommand, read_attribute, run_command

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_TIMEX_BYTES = 256
"""Size of the buffer for ``struct timex``, bytes; the structure is smaller. Its field ``modes`` is
0, so the call of adjtimex only reads the clock state."""
_STATUS_OFFSET = 40
"""Offset of the field ``status`` on 64-bit systems, bytes. Five fields precede it."""
_STA_UNSYNC = 0x40


def clock_is_synchronized() -> bool | None:
    """Return whether the system clock is synchronized (adjtimex); None if unknown."""
    if ctypes.sizeof(ctypes.c_long) != ctypes.sizeof(ctypes.c_int64):
        return None  # 32-bit systems have another layout
    buffer = ctypes.create_string_buffer(_TIMEX_BYTES)
    try:
        if ctypes.CDLL(None, use_errno=True).adjtimex(buffer) < 0:
            return None
    except AttributeError:  # the C library has no adjtimex
        return None
    status = ctypes.c_int.from_buffer(buffer, _STATUS_OFFSET).value
    return not status & _STA_UNSYNC


def can_read_and_write(path: Path) -> bool:
    """Return whether this user may read and write `path`."""
    return os.access(path, os.R_OK | os.W_OK)


def own_groups() -> frozenset[str]:
    """Return the groups of this process."""
    found = set()
    for number in {os.getgid(), *os.getgroups()}:
        try:
            found.add(grp.getgrgid(number).gr_name)
        except KeyError:
            found.add(str(number))
    return frozenset(found)


def members_of(group: str) -> frozenset[str]:
    """Return the members of `group` in the system's group database."""
    try:
        return frozenset(grp.getgrnam(group).gr_mem)
    except KeyError:
        return frozenset()


def group_of(path: Path) -> str:
    """Return the group of a file."""
    number = path.stat().st_gid
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def free_bytes(folder: Path) -> int:
    """Return the free space of the file system of `folder`, bytes."""
    return shutil.disk_usage(folder).free


@dataclass(frozen=True, slots=True)
class Host:
    """The host to check. Tests replace some of the methods.

    Parameters
    ----------
    root
        Folder that contains ``sys``, ``proc``, ``dev``, ``etc`` and ``run``.
    """

    root: Path = Path("/")
    run: RunCommand = run_command
    user: str = field(default_factory=getpass.getuser)
    groups: frozenset[str] = field(default_factory=own_groups)
    may_open: Callable[[Path], bool] = can_read_and_write
    members: Callable[[str], frozenset[str]] = members_of
    group_of: Callable[[Path], str] = group_of
    free_bytes: Callable[[Path], int] = free_bytes
    clock_is_synchronized: Callable[[], bool | None] = clock_is_synchronized

    def at(self, path: str) -> Path:
        """Return an absolute path of the host below the root folder."""
        return self.root / path.lstrip("/") if path.startswith("/") else Path(path)

    def processes(self) -> Iterator[tuple[int, str, Path]]:
        """Yield number, name and ``/proc`` folder of each running process."""
        for folder in (self.root / "proc").glob("[0-9]*"):
            name = read_attribute(folder / "comm")
            if name is not None and folder.name.isdigit():
                yield int(folder.name), name, folder

    def is_running(self, name: str) -> bool:
        """Return whether a process has this name, of which the kernel stores 15 characters."""
        return any(found == name[:15] for _, found, _ in self.processes())

    def holders(self, device: Path) -> list[tuple[int, str]]:
        """Return the processes that have `device` open, as far as this user may inspect them."""
        wanted = device.resolve()
        found = []
        for number, name, folder in self.processes():
            try:
                links = list((folder / "fd").iterdir())
                if any(self.at(str(link.readlink())) == wanted for link in links):
                    found.append((number, name))
            except OSError:  # the process has ended, or belongs to another user
                continue
        return found
