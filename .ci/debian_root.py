"""Debian root file systems, which mmdebstrap makes once a week for virtual machines and tests.

Invariant: a root contains only Debian and no part of the project, so it is valid for every commit.
Its file name contains a digest of its recipe and of the week. In a new week, a new root is made,
with Debian's security updates.
"""

from __future__ import annotations

import datetime
import hashlib
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

SUITE = "bookworm"
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jointfitd"
SEARCH = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"
NAMESPACES = ("--mount", "--propagation=private", "--pid", "--fork", "--kill-child")
"""Options of unshare with which no mount and no process outlives the command."""
_KEPT_DAYS = 21


class RootBuildError(Exception):
    """The root cannot be made on this machine; the message names the reason."""


def kept(
    name: str,
    recipe: str,
    tools: Mapping[str, str],
    make: Callable[[Path], Path],
    cache: Path = CACHE,
    *,
    suite: str = SUITE,
) -> Path:
    """Return the path of a file that is made once a week.

    Parameters
    ----------
    name
        First and last part of the file name, such as ``vm.ext4``.
    recipe
        Text that describes how the file is made. If the text changes, a new file is made.
    tools
        Programs that `make` needs, each with its Debian package.
    make
        Function that makes the file in an empty folder and returns its path.
    cache
        Folder of the stored files.
    suite
        Release of Debian.

    Raises
    ------
    RootBuildError
        Tools are missing, or Debian cannot be reached.
    """
    stem, _, ending = name.partition(".")
    week = datetime.datetime.now(datetime.UTC).strftime("%G-%V").encode()
    made_by = recipe.encode() + Path(__file__).read_bytes() + week
    path = cache / f"{stem}-{suite}-{hashlib.sha256(made_by).hexdigest()[:16]}.{ending}"
    if path.is_file():
        return path

    cache.mkdir(parents=True, exist_ok=True)
    for old in cache.glob(f"{stem}-{suite}-*.{ending}"):
        if time.time() - old.stat().st_mtime > _KEPT_DAYS * 86400:  # noqa: TID251 - a file's age
            old.unlink()

    require(tools)
    with tempfile.TemporaryDirectory(prefix=f"{stem}-", dir=cache) as scratch:
        make(Path(scratch)).replace(path)
    return path


def require(tools: Mapping[str, str]) -> None:
    """Raise `RootBuildError` with the Debian packages of programs that are missing."""
    absent = [deb for tool, deb in tools.items() if shutil.which(tool, path=SEARCH) is None]
    if absent:
        raise RootBuildError(f"apt install {' '.join(absent)}")


def bootstrap(
    packages: Sequence[str],
    hooks: Sequence[str],
    work: Path,
    suite: str = SUITE,
    architecture: str | None = None,
) -> Path:
    """Make ``rootfs.tar`` in `work` from minbase and `packages`, and return its path.

    By default, the root has the architecture of this machine. QEMU emulates another `architecture`.
    """
    # An expired package index is accepted for sid, which has no separate security updates.
    options = ["--aptopt=Acquire::Check-Valid-Until no"] if suite == "sid" else []
    if architecture is not None:
        options.append(f"--architectures={architecture}")
    command = [
        "mmdebstrap", "--variant=minbase", f"--include={','.join(packages)}",
        "--dpkgopt=path-exclude=/usr/share/man/*", "--dpkgopt=path-exclude=/usr/share/locale/*",
        *(f"--customize-hook={hook}" for hook in hooks), *options, suite, "rootfs.tar",
    ]  # fmt: skip
    run(command, work)
    return work / "rootfs.tar"


def become_root() -> list[str]:
    """Return the words to put before a command that needs root."""
    return [] if os.geteuid() == 0 else ["sudo", "-n"]


def enter(script: str, work: Path, namespaces: Sequence[str] = NAMESPACES) -> int:
    """Run a shell script as root in new namespaces, delete `work`, and return the exit status."""
    try:
        return subprocess.run(  # noqa: S603 - our own scripts
            [*become_root(), "unshare", *namespaces, "sh", "-c", script],
            check=False, stdin=subprocess.DEVNULL, env=os.environ | {"PATH": SEARCH},
        ).returncode  # fmt: skip
    finally:
        run([*become_root(), "rm", "-rf", "--one-file-system", str(work)], CACHE)


def run(words: list[str], work: Path) -> None:
    """Run a command in `work`; if it fails, raise `RootBuildError` with the end of its stderr."""
    done = subprocess.run(  # noqa: S603 - fixed commands
        words, cwd=work, env=os.environ | {"PATH": SEARCH}, text=True, capture_output=True,
        check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    if done.returncode:
        raise RootBuildError(f"{words[0]} ended with {done.returncode}:\n{done.stderr[-2000:]}")
