"""Disk of the full virtual machine (Debian with systemd), which is made once a week.

.ci/vm_image.py [--cache DIR]          prints the path of the image
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from debian_root import CACHE, RootBuildError, bootstrap, kept, run

SIZE = "2G"  # sparse file for package and test data
PACKAGES = (
    "systemd", "systemd-sysv", "udev", "dbus", "kmod", "iproute2", "procps", "python3",
    "python3-pytest", "mosquitto", "mosquitto-clients", "openssl", "can-utils",
    "python3-numpy", "python3-scipy",
)  # fmt: skip
TOOLS = {"mmdebstrap": "mmdebstrap", "mke2fs": "e2fsprogs", "fakeroot": "fakeroot"}
HOOKS = (
    # minbase has no hosts file, so localhost would not resolve.
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


def main() -> int:
    """Print the path of the image, which is made if it does not exist."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cache", type=Path, default=CACHE, metavar="DIR")
    try:
        print(image(parser.parse_args().cache))
    except RootBuildError as error:
        print(f"vm_image: {error}", file=sys.stderr)
        return 2
    return 0


def image(cache: Path = CACHE) -> Path:
    """Return the image for this week; make it if necessary (about a minute).

    Raises
    ------
    RootBuildError
        Tools are missing, or Debian cannot be reached.
    """
    return kept("vm.ext4", Path(__file__).read_text(encoding="utf-8"), TOOLS, _make, cache)


def _make(work: Path) -> Path:
    bootstrap(PACKAGES, HOOKS, work)
    run(["fakeroot", "sh", "-ec", TO_DISK.format(size=SIZE)], work)
    return work / "rootfs.ext4"


if __name__ == "__main__":
    sys.exit(main())
