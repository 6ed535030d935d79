#!/usr/bin/env python3
"""Run tests on a kernel with SocketCAN, in a virtual machine that is an ordinary process.

    .ci/light_vm.py [--time-limit S] [--memory M] [--out DIR] [-- PYTEST ARGUMENTS]

The script boots Debian's user-mode-linux (packages: user-mode-linux, iproute2). The root file
system of the guest is the host's, read-only. The guest starts vcan0 and runs ``pytest -m vm
tests/vm`` with the Python that runs this script. Of the host's folders, the guest can write to DIR
only. DIR receives junit.xml.

The exit status is the status of pytest; 1 if a test was skipped or no test ran; 90 if the guest did
not reach the end of pytest; 124 at the time limit; 2 if the machine cannot be started.
"""

# ruff: noqa: S108 - the guest's folders are named, not used here

from __future__ import annotations

import argparse
import ctypes
import os
import shlex
import sys
import tempfile
import time
from pathlib import Path

import uml
from uml import say

CHECKOUT = Path(__file__).resolve().parents[1]
CAN_MODULES = (
    "net/can/can",
    "net/can/can-raw",
    "drivers/net/can/dev/can-dev",
    "drivers/net/can/vcan",
    "drivers/net/veth",
)
HIDDEN = ("/tmp", "/run", "/var/tmp", "/mnt")
"""Folders that are empty in the guest. Subfolders that the tests need are mounted again."""

PREPARE = """\
#!/bin/sh
# PID 1 of the guest. It must power off by itself: if it returned, the kernel would panic.
export PATH=/usr/sbin:/usr/bin:/sbin:/bin HOME=/tmp LANG=C.UTF-8 CI=1
export PYTHONDONTWRITEBYTECODE=1 PYTHONUNBUFFERED=1 HYPOTHESIS_STORAGE_DIRECTORY=/tmp/hypothesis
export {environment}
exec < /dev/null > /dev/console 2>&1
mount -t proc proc /proc
mount -t sysfs sys /sys
echo {no_result} > /proc/exitcode
{mounts}
mountpoint -q /dev || mount -t devtmpfs dev /dev
mkdir -p /dev/pts /dev/shm
mount -t devpts pts /dev/pts
mount -t tmpfs shm /dev/shm
cd {checkout}
"""
TESTS = """\
{python} {script} --guest-modules
ip link set lo up
ip link add dev vcan0 type vcan && ip link set vcan0 up && echo "light_vm: vcan0 is up"
{python} -m pytest --color=no -p no:cacheprovider --basetemp=/tmp/pytest \\
    --junitxml=/mnt/out/junit.xml {tests}
echo $? > /proc/exitcode
"""
END = """\
exec {python} -c 'import ctypes; ctypes.CDLL(None).reboot(0x4321fedc)'
"""


def main() -> int:
    """Boot the machine, run the tests, and evaluate their report."""
    given = arguments()
    if given.guest_modules:
        return load_modules()
    absent = uml.missing(uml.UML, "ip")
    if absent:
        say(f"{', '.join(absent)} not found: apt install user-mode-linux iproute2")
        return uml.CANNOT_START
    with tempfile.TemporaryDirectory(prefix="light-vm-") as scratch:
        work = Path(scratch)
        out = Path(given.out).resolve() if given.out else work / "out"
        out.mkdir(parents=True, exist_ok=True)
        (out / "junit.xml").unlink(missing_ok=True)
        tests = shlex.join(given.tests or ["-m", "vm", "tests/vm"])
        script = shlex.quote(str(Path(__file__).resolve()))
        write_init(work / "init", out, TESTS, script=script, tests=tests)
        say(f"checkout {CHECKOUT}, Python {sys.executable}, pytest {tests}")
        began = time.monotonic()
        code = uml.boot(machine_command(work, given.memory), given.time_limit)
        say(f"the machine ended with {code} after {time.monotonic() - began:.1f} s")
        return uml.judge(code, out / "junit.xml")


def arguments() -> argparse.Namespace:
    """Return the command-line arguments."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--time-limit", type=float, default=180.0, help="seconds, whole run")
    parser.add_argument("--memory", default="512M", help="memory of the guest")
    parser.add_argument("--out", help="folder for junit.xml (default: not kept)")
    parser.add_argument("--guest-modules", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("tests", nargs="*", help="pytest arguments (default: -m vm tests/vm)")
    return parser.parse_args()


def mounts(out: Path) -> list[str]:
    """Return shell commands that hide the host's volatile folders and mount the needed parts."""
    needed = {CHECKOUT, Path(sys.prefix), Path(sys.base_prefix)}
    shared = CHECKOUT.parent / "shared" / "data"
    if shared.is_dir():
        needed.add(shared)
    paths = sorted({path for each in needed for path in (each, each.resolve())})
    lines = [f"mount -t tmpfs tmpfs {folder}" for folder in HIDDEN if Path(folder).is_dir()]
    for path in paths:
        if any(path.is_relative_to(folder) for folder in HIDDEN):
            quoted = shlex.quote(str(path))
            lines.append(f"mkdir -p {quoted} && mount -r -t hostfs none {quoted} -o {quoted}")
            say(f"mounting {path} in the guest, read-only")
    lines.append("mkdir -p /mnt/out")
    lines.append(f"mount -t hostfs none /mnt/out -o {shlex.quote(str(out))}")
    return lines


def write_init(path: Path, out: Path, commands: str, **words: str) -> None:
    """Write PID 1 of the guest, which runs `commands` in the checkout and powers off."""
    guest = {"LIGHT_VM": "1"} | (uml.NO_AVX if uml.has_amx() else {})
    text = (PREPARE + commands + END).format(
        no_result=uml.NO_RESULT,
        environment=shlex.join(f"{k}={v}" for k, v in guest.items()),
        mounts="\n".join(mounts(out)),
        checkout=shlex.quote(str(CHECKOUT)),
        python=shlex.quote(sys.executable),
        **words,
    )
    path.write_text(text)
    path.chmod(0o755)


def machine_command(work: Path, memory: str, *more: str) -> list[str]:
    """Return the command of a machine whose root is the host's file system, read-only."""
    return [
        uml.UML, f"mem={memory}", "rootfstype=hostfs", "rootflags=/", "ro", f"init={work / 'init'}",
        *uml.CONSOLE, "quiet", f"uml_dir={work}", "umid=light", *more,
    ]  # fmt: skip


def load_modules() -> int:
    """Load the CAN modules without kmod, in the guest."""
    libc = ctypes.CDLL(None, use_errno=True)
    for name in CAN_MODULES:
        path = uml.MODULES / os.uname().release / "kernel" / f"{name}.ko"
        descriptor = os.open(path, os.O_RDONLY)
        if libc.syscall(313, descriptor, b"", 0):  # finit_module, x86-64
            say(f"{name}: {os.strerror(ctypes.get_errno())}")
        os.close(descriptor)
    return 0


if __name__ == "__main__":
    sys.exit(main())
