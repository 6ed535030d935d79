"""The state directory: locked by one daemon, private to its user, checked for writing.

Invariant: the lock lives in the kernel and ends with its process, so no lock is ever stale.
"""

from __future__ import annotations

import errno
import fcntl
import os
from pathlib import Path
from stat import S_ISLNK, S_ISREG, S_ISVTX
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

LOCK = "lock"
"""Name of the lock file; it holds the process id of the daemon."""
PRIVATE_UMASK = 0o077
_DIRECTORY_MODE, _FILE_MODE = 0o700, 0o600
_OWNED = ("calibrations", "recordings")
"""Folders whose files a daemon wrote; others in the state directory may belong to somebody else."""
_PROBE_BYTES = bytes(4096)  # a full disk takes an empty file
_HELD = (errno.EWOULDBLOCK, errno.EACCES)


class StateDirectoryInUseError(Exception):
    """Another daemon holds the lock; the message names its process."""


def state_directory() -> Path:
    """Return where the daemon stores what outlives it: systemd's choice, else ./state."""
    return Path(os.environ.get("STATE_DIRECTORY", "state").split(":")[0])


def lock_state(directory: Path) -> int | None:
    """Lock `directory` for this process and return the descriptor that holds the lock.

    Returns None where nothing can be locked: a directory that cannot be written has no state to
    protect, and some network file systems have no locks.

    Raises
    ------
    StateDirectoryInUseError
        Another daemon uses it.
    """
    path = directory / LOCK
    try:
        directory.mkdir(mode=_DIRECTORY_MODE, parents=True, exist_ok=True)
        descriptor = os.open(
            path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK, _FILE_MODE
        )
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
    except OSError as error:
        holder = os.pread(descriptor, 32, 0).decode("ascii", "replace").strip()
        if error.errno not in _HELD:  # locked, but the disk is full; or no locks here
            return descriptor
        os.close(descriptor)
        raise StateDirectoryInUseError(
            f"state directory {directory.absolute()} is used by another jointfitd "
            f"(process {holder or 'unknown'}): stop that one, or set STATE_DIRECTORY to a "
            "directory of its own for each rig"
        ) from error
    return descriptor


def make_private(directory: Path) -> None:
    """Take the rights of group and others away from what earlier daemons wrote.

    Only files of this user are changed, and only in the folders that a daemon writes.
    """
    for path in _written(directory):
        try:
            found = path.lstat()
            shared = found.st_mode & PRIVATE_UMASK and not found.st_mode & S_ISVTX
            if found.st_uid == os.geteuid() and shared and not S_ISLNK(found.st_mode):
                path.chmod(_FILE_MODE if S_ISREG(found.st_mode) else _DIRECTORY_MODE)
        except OSError:
            continue  # read-only or gone: the check for writing reports it


def _written(directory: Path) -> Iterator[Path]:
    """Yield what daemons wrote: their files and folders, without links, and the directory."""
    for name in _OWNED:
        for folder, _, files in os.walk(directory / name):
            yield Path(folder)
            yield from (path for path in (Path(folder, name) for name in files) if path.is_file())
    if any((directory / name).is_dir() for name in _OWNED):
        yield directory


def write_fault(directory: Path) -> str | None:
    """Return why no file can be written to `directory`, or None if one can."""
    probe = directory / f".probe-{os.getpid()}"
    try:
        directory.mkdir(mode=_DIRECTORY_MODE, parents=True, exist_ok=True)
        try:
            probe.write_bytes(_PROBE_BYTES)
        finally:
            probe.unlink(missing_ok=True)
    except OSError as error:
        return f"{directory.absolute()}: {error.strerror or error}"
    return None
