"""Run the tests and the demo on a new minimal Debian system, as a new user without root access.

    .ci/minimal_root.py [--suite NAME] [--out DIR] [-- SHELL COMMAND]

The system is mmdebstrap's minbase with `PACKAGES`. It has no broker and no host name localhost. The
tests run as an ordinary user in separate namespaces, on a clone of the last commit. If the kernel
has time namespaces, the uptime is one minute. Only the set-up needs root (or sudo). The
configuration of pip, the files that it names, and the network are those of the host. The JUnit
reports are written to DIR (default: ``build/minimal``).

The exit status is that of the command, or 2 if the system cannot be set up.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from debian_root import (
    CACHE,
    NAMESPACES,
    SEARCH,
    SUITE,
    RootBuildError,
    become_root,
    bootstrap,
    enter,
    kept,
    run,
)

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGES = ("python3", "python3-venv", "make", "git", "ca-certificates")
DEMO = "make demo ARGS='--headless --seconds 20'"
COMMAND = f"make test && {{ {DEMO} || {{ echo 'the demo failed: once more'; {DEMO}; }}; }}"
"""Command to run. The demo runs in real time, and other load of the host can disturb it, so it has
two attempts."""
UPTIME_S = 60
HOME = Path("/home/stranger")
PIP_CONFIGURATIONS = (
    (Path("/etc/pip.conf"), Path("/etc/pip.conf")),
    (Path("/etc/xdg/pip/pip.conf"), Path("/etc/xdg/pip/pip.conf")),
    (Path.home() / ".pip/pip.conf", HOME / ".pip/pip.conf"),
    (Path.home() / ".config/pip/pip.conf", HOME / ".config/pip/pip.conf"),
)
"""Paths of pip's configuration files on the host and in the new system."""
PASSED = re.compile(
    r"PIP_(?!CACHE_DIR)\w+|(https?|no)_proxy|SSL_CERT_FILE|REQUESTS_CA_BUNDLE", re.IGNORECASE
)
"""Names of the environment variables that pip needs in the new system."""
ABSOLUTE = re.compile(r"(file://)?(/[^\s,;\"']+)")

SET_UP = """\
set -eu
root={work}/root
mkdir "$root"
tar -xf {tar} -C "$root" --numeric-owner
echo stranger:x:1000:1000::{home}:/bin/sh >> "$root/etc/passwd"
echo stranger:x:1000: >> "$root/etc/group"
mkdir -p "$root{home}"
mv {work}/checkout "$root{home}/jointfitd"
cp -L /etc/resolv.conf "$root/etc/resolv.conf"

# Devices that programs of a user need, and terminals that are separate from the host's.
mount -t proc proc "$root/proc"
mount --rbind /sys "$root/sys"
mount -t tmpfs -o mode=755 dev "$root/dev"
for name in null zero full random urandom tty; do
  : > "$root/dev/$name"
  mount --bind "/dev/$name" "$root/dev/$name"
done
mkdir "$root/dev/pts" "$root/dev/shm"
mount -t devpts -o newinstance,ptmxmode=0666,mode=0620 devpts "$root/dev/pts"
mount -t tmpfs -o mode=1777 shm "$root/dev/shm"
ln -s pts/ptmx "$root/dev/ptmx"
ln -s /proc/self/fd "$root/dev/fd"

share() {{
  if [ -d "$1" ]; then mkdir -p "$root$2"; else mkdir -p "$(dirname "$root$2")"; : >> "$root$2"; fi
  mount --bind "$1" "$root$2"
  mount -o remount,ro,bind "$root$2"
}}
{shares}
chown -R 1000:1000 "$root{home}" 2>/dev/null || true  # fails for shared files, which are read-only

inside() {{ chroot --userspec=1000:1000 --groups= "$root" env -i {environment} sh -c "$1"; }}
echo "minimal root: Debian $(cat "$root/etc/debian_version"), minbase and" \\
  "$(chroot "$root" dpkg-query -W -f='${{Package}} ${{Version}}, ' {packages})" \\
  "$(chroot "$root" dpkg-query -W | wc -l) packages in all; uptime $(cut -d. -f1 /proc/uptime) s"
inside "id; cat /etc/hosts 2>/dev/null || echo no hosts file"
status=0
inside {command} || status=$?
cp "$root{home}"/jointfitd/build/tests/*.xml {out}/ 2>/dev/null || true
chown {owner} {out}/*.xml 2>/dev/null || true
exit $status
"""


def main() -> int:
    """Set up the system, and run the command in it; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=CHECKOUT / "build" / "minimal", metavar="DIR")
    parser.add_argument("--suite", default=SUITE, help="release of Debian (default: %(default)s)")
    parser.add_argument("command", nargs="*", help=f"default: {COMMAND}")
    given = parser.parse_args()
    command = " ".join(given.command) or COMMAND

    given.out.mkdir(parents=True, exist_ok=True)
    for old in given.out.glob("*.xml"):
        old.unlink()
    try:
        tar = kept(
            "minimal.tar", " ".join(PACKAGES), {"mmdebstrap": "mmdebstrap"},
            lambda work: bootstrap(PACKAGES, (), work, given.suite), suite=given.suite,
        )  # fmt: skip
        # `enter` deletes the folder, whose files then belong to root.
        work = Path(tempfile.mkdtemp(prefix="minimal-run-", dir=CACHE))
        run(["git", "clone", "-q", "--depth=1", f"file://{CHECKOUT}", "checkout"], work)
        return enter(_script(work, tar, given.out.resolve(), command), work, _namespaces())
    except RootBuildError as error:
        print(f"minimal_root: {error}", file=sys.stderr)
        return 2


def _namespaces() -> tuple[str, ...]:
    """Return the options of unshare, with the start of the clocks if this kernel can set it."""
    monotonic = UPTIME_S - int(time.clock_gettime(time.CLOCK_MONOTONIC))
    boottime = UPTIME_S - int(time.clock_gettime(time.CLOCK_BOOTTIME))
    clocks = ["--time", f"--monotonic={monotonic}", f"--boottime={boottime}"]
    tried = subprocess.run(  # noqa: S603 - as below
        [*become_root(), "unshare", *NAMESPACES, *clocks, "true"],
        check=False, capture_output=True, env=os.environ | {"PATH": SEARCH},
    )  # fmt: skip
    if tried.returncode == 0:
        return (*NAMESPACES, *clocks)
    print("minimal_root: this kernel allows no time namespace; the uptime is the host's")
    return NAMESPACES


def _script(work: Path, tar: Path, out: Path, command: str) -> str:
    environment = {name: text for name, text in os.environ.items() if PASSED.fullmatch(name)}
    shared = _shared([*environment.values(), *_read_configurations()])
    shares = [*((path, path) for path in shared), *_configurations()]
    environment |= {
        "HOME": str(HOME), "PATH": "/usr/bin:/bin", "LANG": "C.UTF-8", "CI": "true",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1", "OPENBLAS_NUM_THREADS": "1",
    }  # fmt: skip
    return SET_UP.format(
        work=shlex.quote(str(work)), tar=shlex.quote(str(tar)), out=shlex.quote(str(out)),
        shares="\n".join(f"share {shlex.join(map(str, pair))}" for pair in shares),
        environment=shlex.join(f"{name}={text}" for name, text in environment.items()),
        home=HOME, packages=" ".join(PACKAGES), owner=f"{os.getuid()}:{os.getgid()}",
        command=shlex.quote(f"cd {HOME}/jointfitd && {command}"),
    )  # fmt: skip


def _configurations() -> list[tuple[Path, Path]]:
    return [(host, inside) for host, inside in PIP_CONFIGURATIONS if host.is_file()]


def _read_configurations() -> list[str]:
    named = os.environ.get("PIP_CONFIG_FILE")
    files = [host for host, _ in _configurations()] + ([Path(named)] if named else [])
    return [file.read_text(encoding="utf-8") for file in files if file.is_file()]


def _shared(texts: list[str]) -> list[Path]:
    """Return the existing files and folders that pip's settings name, in order of depth."""
    found = set()
    for scheme, name in (match.groups() for text in texts for match in ABSOLUTE.finditer(text)):
        path = Path(name)
        if scheme and path.parent != Path("/"):  # a package index links to files in its folder
            path = path.parent
        if path.exists() and not path.samefile(os.devnull):
            found.add(path)
    return sorted(found, key=lambda path: len(path.parts))


if __name__ == "__main__":
    sys.exit(main())
