"""The state directory: exclusive lock, private permissions, and a check for write access.

Invariant: the kernel owns the lock and releases it when the process ends, so no lock is stale.
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
"""Name of the lock file, which contains the process id of the daemon."""
PRIVATE_UMASK = 0o077
"""Umask of the daemon, because calibrations and recordings are personal data."""
_DIRECTORY_MODE, _FILE_MODE = 0o700, 0o600
_OWNED = ("calibrations", "recordings", "spool")
"""Folders that the daemon writes. Other folders in the state directory may belong to other
programs."""
WRITE_REMEDY = "check mount, permissions and free space, or set STATE_DIRECTORY"
"""Remedy for a directory that cannot be written."""
_PROBE_BYTES = bytes(4096)
"""Content of the probe file. It is not empty, because a full disk accepts an empty file."""
_HELD = (errno.EWOULDBLOCK, errno.EACCES)


class StateDirectoryInUseError(Exception):
    """Another daemon owns the lock; the message contains its process id."""


def state_directory() -> Path:
    """Return the folder of persistent data: $STATE_DIRECTORY (set by systemd), or ./state."""
    return Path(os.environ.get("STATE_DIRECTORY", "state").split(":")[0])


def lock_state(directory: Path) -> int | None:
    """Lock `directory` for this process, and return the descriptor that owns the lock.

    Return None if no lock file can be created, because this process then cannot write to the
    directory either. On network file systems without locks, the descriptor of the file is returned
    without a lock.

    Raises
    ------
    StateDirectoryInUseError
        Another daemon uses the directory.
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
        if error.errno not in _HELD:  # locked but the disk is full, or locks are unsupported
            return descriptor
        os.close(descriptor)
        raise StateDirectoryInUseError(
            f"state directory {directory.absolute()} is used by another jointfitd "
            f"(process {holder or 'unknown'}): stop that process, or set STATE_DIRECTORY to a "
            "separate directory for each rig"
        ) from error
    return descriptor


def lock_again(directory: Path) -> int | None:
    """Lock `directory` as `lock_state` does; return None if this process already owns the lock.

    The function is used for a directory that was not writable at the start, and was therefore not
    locked.
    """
    try:
        holder = (directory / LOCK).read_text(encoding="ascii", errors="replace").strip()
    except OSError:
        holder = ""
    return lock_state(directory) if holder != str(os.getpid()) else None


def make_private(directory: Path) -> None:
    """Remove the permissions of group and others from files and folders that daemons created.

    Files and folders of other users are not changed.
    """
    for path in _owned_paths(directory):
        try:
            found = path.lstat()
            shared = found.st_mode & PRIVATE_UMASK and not found.st_mode & S_ISVTX
            if found.st_uid == os.geteuid() and shared and not S_ISLNK(found.st_mode):
                path.chmod(_FILE_MODE if S_ISREG(found.st_mode) else _DIRECTORY_MODE)
        except OSError:
            continue  # read-only or absent: `write_fault` reports it


def _owned_paths(directory: Path) -> Iterator[Path]:
    """Yield the directory, and the files and folders in it that daemons wrote, without links."""
    for name in _OWNED:
        for folder, _, files in os.walk(directory / name):
            yield Path(folder)
            yield from (path for path in (Path(folder, name) for name in files) if path.is_file())
    if any((directory / name).is_dir() for name in _OWNED):
        yield directory


def write_fault(directory: Path) -> str | None:
    """Return the reason why no file can be written to `directory`; None if it can be written."""
    probe = directory / f".probe-{os.getpid()}"
    try:
        directory.mkdir(mode=_DIRECTORY_MODE, parents=True, exist_ok=True)
        try:
            probe.write_bytes(_PROBE_BYTES)
        finally:
            probe.unlink(missing_ok=True)
    except OSError as error:
        return describe_write_error(error, directory)
    return None


def describe_write_error(error: OSError, directory: Path) -> str:
    """Return a text that names the directory and the reason why it cannot be written."""
    return f"{directory.absolute()}: {error.strerror or error}"
