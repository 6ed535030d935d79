"""Debian roots made with mmdebstrap once a week and kept: the disk of a machine, a minimal system.

Invariant: a root holds Debian and nothing of the project, so it stays good from commit to commit.
Its name is a digest of its packages and scripts and of the week: a new week brings Debian's
security updates.
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
_KEPT_DAYS = 21


class RootBuildError(Exception):
    """The root cannot be made here, and why."""


def kept(
    name: str,
    recipe: str,
    tools: Mapping[str, str],
    make: Callable[[Path], Path],
    cache: Path = CACHE,
    *,
    suite: str = SUITE,
) -> Path:
    """Return a file that is made once a week.

    Parameters
    ----------
    name
        Begin and end of the file's name, as ``vm.ext4``.
    recipe
        Text of how it is made: changed, it makes a new one.
    tools
        Programs that `make` needs, and their Debian packages.
    make
        Makes the file in an empty folder and returns its path.
    cache
        Folder of the files that are kept.
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

    absent = [deb for tool, deb in tools.items() if shutil.which(tool, path=SEARCH) is None]
    if absent:
        raise RootBuildError(f"apt install {' '.join(absent)}")
    with tempfile.TemporaryDirectory(prefix=f"{stem}-", dir=cache) as scratch:
        make(Path(scratch)).replace(path)
    return path


def bootstrap(
    packages: Sequence[str], hooks: Sequence[str], work: Path, suite: str = SUITE
) -> Path:
    """Make ``rootfs.tar`` in `work`: minbase and `packages`, without manual pages."""
    # Unstable has no security updates that an old mirror would hide.
    options = ["--aptopt=Acquire::Check-Valid-Until no"] if suite == "sid" else []
    command = [
        "mmdebstrap", "--variant=minbase", f"--include={','.join(packages)}",
        "--dpkgopt=path-exclude=/usr/share/man/*", "--dpkgopt=path-exclude=/usr/share/locale/*",
        *(f"--customize-hook={hook}" for hook in hooks), *options, suite, "rootfs.tar",
    ]  # fmt: skip
    run(command, work)
    return work / "rootfs.tar"


def run(words: list[str], work: Path) -> None:
    """Run a command in `work`; raise `RootBuildError` with the end of its errors if it fails."""
    done = subprocess.run(  # noqa: S603 - fixed commands
        words, cwd=work, env=os.environ | {"PATH": SEARCH}, text=True, capture_output=True,
        check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    if done.returncode:
        raise RootBuildError(f"{words[0]} ended with {done.returncode}:\n{done.stderr[-2000:]}")
