"""Install a Debian package in Debian systems, and run the demo there: `deb_root.py PACKAGE`.

    .ci/deb_root.py [--suite NAME ...] PACKAGE

Each system is mmdebstrap's minbase with the packages on which jointfitd depends. Root installs the
package; an ordinary user runs the demo. The demo runs in real time, so it has two attempts. Only
the set-up needs root (or sudo). `.ci/arm_root.py` runs the tests in such a system.

The exit status is 1 if the demo failed, or 2 if a system cannot be set up.
"""

from __future__ import annotations

import argparse
import platform
import re
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path

from debian_root import CACHE, RootBuildError, bootstrap, enter, kept

SUITES = ("trixie",)
"""Releases of Debian. ``full_vm.py`` tests the package on the release bookworm."""
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
    env -i HOME=/tmp PATH=/usr/bin:/bin LANG=C.UTF-8 OPENBLAS_NUM_THREADS=1 sh -c "cd /tmp && $1"
}}
echo "Debian $(cat "$root/etc/debian_version"): $(chroot "$root" uname -m)," \\
  "jointfit $(inside 'jointfit --version')"
"""
"""Shell commands that install the package and define `inside`, which runs a command as a user."""
DEMO = """\
demo='jointfit demo --headless --seconds 10'
inside "$demo" || { echo 'the demo failed: once more'; inside "$demo"; }
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
        return max(int(with_package(given.package, suite, DEMO) != 0) for suite in given.suite)
    except RootBuildError as error:
        print(f"deb_root: {error}", file=sys.stderr)
        return 2


def with_package(package: Path, suite: str, script: str) -> int:
    """Run `SET_UP` and a shell script in a new system with a package; return the exit status."""
    if not package.is_file():
        raise RootBuildError(f"{package}: no such package: make deb")
    architecture = field(package, "Architecture")
    needed = re.sub(r"\(.*?\)", "", field(package, "Depends")).replace(",", " ").split()
    needed = list(dict.fromkeys(needed))
    tar = kept(
        f"package-{architecture}.tar", " ".join(needed), tools_for(architecture),
        lambda work: bootstrap(needed, (), work, suite, architecture), suite=suite,
    )  # fmt: skip
    work = Path(tempfile.mkdtemp(prefix="package-run-", dir=CACHE))
    paths = {"work": work, "tar": tar, "package": package.resolve()}
    set_up = SET_UP.format_map({name: shlex.quote(str(each)) for name, each in paths.items()})
    return enter(set_up + script, work)


def tools_for(architecture: str) -> dict[str, str]:
    """Return the programs that make a system of an architecture, each with its Debian package."""
    tools = {"mmdebstrap": "mmdebstrap"}
    if architecture == "arm64" and platform.machine() != "aarch64":
        tools["qemu-aarch64-static"] = "qemu-user-static binfmt-support"
        tools["arch-test"] = "arch-test"  # mmdebstrap tests the emulation with it
    return tools


def field(package: Path, name: str) -> str:
    """Return a field of the control file of a package."""
    return subprocess.run(  # noqa: S603 - as below
        ["dpkg-deb", "-f", str(package), name],  # noqa: S607 - Debian's
        text=True, capture_output=True, check=True,
    ).stdout.strip()  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
