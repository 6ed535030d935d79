"""Install a Debian package in Debian systems, and run the demo there: `deb_root.py PACKAGE`.

    .ci/deb_root.py [--suite NAME ...] PACKAGE

Each system is mmdebstrap's minbase with the packages on which ours depends. Root installs the
package; an ordinary user runs the demo. The demo runs in real time, so it has two attempts. Only
the set-up needs root (or sudo).

The exit status is 1 if the demo failed, or 2 if a system cannot be set up.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from debian_root import CACHE, SEARCH, RootBuildError, bootstrap, kept, run

SUITES = ("trixie",)
"""Releases other than that of the virtual machine with the service."""
DEMO = "jointfit demo --headless --seconds 10"
SET_UP = """\
set -eu
root={work}/root
mkdir "$root"
tar -xf {tar} -C "$root" --numeric-owner
cp {package} "$root/package.deb"
mount -t proc proc "$root/proc"
mount --rbind /sys "$root/sys"
mount --rbind /dev "$root/dev"
chroot "$root" dpkg -i /package.deb
echo stranger:x:1000:1000::/tmp:/bin/sh >> "$root/etc/passwd"
inside() {{
  chroot --userspec=1000:1000 --groups= "$root" \\
    env -i HOME=/tmp PATH=/usr/bin:/bin LANG=C.UTF-8 sh -c "cd /tmp && $1"
}}
echo "Debian $(cat "$root/etc/debian_version"): jointfit $(inside 'jointfit --version')"
inside {demo} || {{ echo 'the demo failed: once more'; inside {demo}; }}
chroot "$root" dpkg -r jointfitd
if [ -e "$root/usr/lib/jointfitd" ]; then
  echo 'the removal left files:'
  find "$root/usr/lib/jointfitd" | head
  exit 1
fi
"""


def main() -> int:
    """Set up each system, and run the demo in it; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--suite", nargs="+", default=SUITES, help="releases of Debian")
    parser.add_argument("package", type=Path)
    given = parser.parse_args()
    try:
        return max(_check(given.package.resolve(), suite) for suite in given.suite)
    except RootBuildError as error:
        print(f"deb_root: {error}", file=sys.stderr)
        return 2


def _check(package: Path, suite: str) -> int:
    needed = _needed(package)
    tar = kept(
        "package.tar", " ".join(needed), {"mmdebstrap": "mmdebstrap"},
        lambda work: bootstrap(needed, (), work, suite), suite=suite,
    )  # fmt: skip
    root = [] if os.geteuid() == 0 else ["sudo", "-n"]
    work = Path(tempfile.mkdtemp(prefix="package-run-", dir=CACHE))
    paths = {"work": work, "tar": tar, "package": package, "demo": DEMO}
    script = SET_UP.format_map({name: shlex.quote(str(each)) for name, each in paths.items()})
    enter = ["unshare", "--mount", "--propagation=private", "--pid", "--fork", "--kill-child"]
    try:
        ended = subprocess.run(  # noqa: S603 - our own script
            [*root, *enter, "sh", "-c", script],
            check=False, stdin=subprocess.DEVNULL, env=os.environ | {"PATH": SEARCH},
        )  # fmt: skip
    finally:
        run([*root, "rm", "-rf", "--one-file-system", str(work)], CACHE)
    return int(ended.returncode != 0)


def _needed(package: Path) -> list[str]:
    """Return the names of the packages on which a package depends."""
    field = subprocess.run(  # noqa: S603 - as below
        ["dpkg-deb", "-f", str(package), "Depends"],  # noqa: S607 - Debian's
        text=True, capture_output=True, check=True,
    ).stdout  # fmt: skip
    return list(dict.fromkeys(re.sub(r"\(.*?\)", "", field).replace(",", " ").split()))


if __name__ == "__main__":
    sys.exit(main())
