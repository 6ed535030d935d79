"""The disk of the full virtual machine: Debian with systemd, made once and kept.

    .ci/vm_image.py [--cache DIR]          prints the path of the image

Law: the image holds Debian and nothing of the project, so it stays good from commit to commit. Its
name is a digest of what made it (this file, the suite) and the week: a new week brings Debian's
security updates.
"""

from __future__ import annotations

import argparse
import datetime
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SUITE = "bookworm"
SIZE = "2G"  # sparse; the package and what tests write must fit
CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "jointfitd"
PACKAGES = (
    "systemd", "systemd-sysv", "udev", "dbus", "kmod", "iproute2", "procps", "python3",
    "python3-pytest", "mosquitto", "mosquitto-clients", "openssl", "can-utils",
)  # fmt: skip
TOOLS = {"mmdebstrap": "mmdebstrap", "mke2fs": "e2fsprogs", "fakeroot": "fakeroot"}
HOOKS = (
    # minbase has no hosts file: localhost would not resolve
    'printf "127.0.0.1 localhost vm\\n::1 localhost\\n" > "$1/etc/hosts"',
    'echo vm > "$1/etc/hostname"; : > "$1/etc/machine-id"; mkdir -p "$1/usr/lib/modules"',
)
TO_DISK = """
mkdir rootfs
tar -xf rootfs.tar -C rootfs --numeric-owner
truncate -s {size} rootfs.ext4
mke2fs -q -t ext4 -F -m 0 -d rootfs rootfs.ext4
rm -r rootfs rootfs.tar
"""
_KEPT_DAYS = 21


def main() -> int:
    """Print the image's path, having made it where it was not there."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cache", type=Path, default=CACHE, metavar="DIR")
    try:
        print(image(parser.parse_args().cache))
    except CannotMake as error:
        print(f"vm_image: {error}", file=sys.stderr)
        return 2
    return 0


class CannotMake(Exception):  # noqa: N818 - named for what happened
    """The image cannot be made here, and why."""


def image(cache: Path = CACHE) -> Path:
    """Return the image for this week, made if need be (about a minute).

    Raises
    ------
    CannotMake
        Tools are missing, or Debian cannot be reached.
    """
    week = datetime.datetime.now(datetime.UTC).strftime("%G-%V")
    digest = hashlib.sha256(Path(__file__).read_bytes() + week.encode()).hexdigest()[:16]
    path = cache / f"vm-{SUITE}-{digest}.ext4"
    if not path.is_file():
        cache.mkdir(parents=True, exist_ok=True)
        _forget_old(cache)
        _make(path)
    return path


def _forget_old(cache: Path) -> None:
    for old in cache.glob(f"vm-{SUITE}-*.ext4"):
        if time.time() - old.stat().st_mtime > _KEPT_DAYS * 86400:  # noqa: TID251 - a file's age
            old.unlink()


def _make(path: Path) -> None:
    search = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"
    absent = [deb for tool, deb in TOOLS.items() if shutil.which(tool, path=search) is None]
    if absent:
        raise CannotMake(f"apt install {' '.join(absent)}")
    with tempfile.TemporaryDirectory(prefix="vm-image-", dir=path.parent) as scratch:
        work = Path(scratch)
        debian = [
            "mmdebstrap", "--variant=minbase", f"--include={','.join(PACKAGES)}",
            "--dpkgopt=path-exclude=/usr/share/man/*", "--dpkgopt=path-exclude=/usr/share/locale/*",
            *(f"--customize-hook={hook}" for hook in HOOKS), SUITE, "rootfs.tar",
        ]  # fmt: skip
        _run(debian, work, search)
        _run(["fakeroot", "sh", "-ec", TO_DISK.format(size=SIZE)], work, search)
        (work / "rootfs.ext4").replace(path)


def _run(words: list[str], work: Path, search: str) -> None:
    done = subprocess.run(  # noqa: S603 - fixed commands
        words, cwd=work, env=os.environ | {"PATH": search}, text=True, capture_output=True,
        check=False, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    if done.returncode:
        raise CannotMake(f"{words[0]} ended with {done.returncode}:\n{done.stderr[-2000:]}")


if __name__ == "__main__":
    sys.exit(main())
