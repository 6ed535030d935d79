#!/usr/bin/env python3
"""Run the installed service: the Debian package in a virtual machine with real systemd.

    .ci/full_vm.py [--deb FILE] [--image FILE] [--time-limit S] [--out DIR] [-- PYTEST ARGUMENTS]

The script boots Debian (``vm_image.py``) under user-mode-linux and installs the package. It starts
a real vcan interface and a real mosquitto with TLS and passwords, and runs ``tests/vm_service``
inside. Each run writes to its own temporary disk.

The exit status is the same as for ``light_vm.py``: the status of pytest; 1 if a test was skipped or
no test ran; 90 if the guest did not reach the end of pytest; 124 at the time limit; 2 if the
machine cannot be started.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import debian_root
import uml
import vm_image
from uml import say

CHECKOUT = Path(__file__).resolve().parents[1]
TESTS = CHECKOUT / "tests" / "vm_service"
UNUSED = (
    "e2scrub_reap.service", "systemd-networkd-wait-online.service", "systemd-logind.service",
    "systemd-binfmt.service", "dev-hugepages.mount", "sys-kernel-config.mount",
    "sys-fs-fuse-connections.mount", "modprobe@configfs.service", "modprobe@dm_mod.service",
    "modprobe@drm.service", "modprobe@efi_pstore.service", "modprobe@fuse.service",
    "modprobe@loop.service", "apt-daily.timer", "apt-daily-upgrade.timer",
)  # fmt: skip
"""Debian units that the tests do not need. Without them, the boot is one and a half seconds faster.
"""
START = (
    "echo {no_result} > /proc/exitcode; mount -t hostfs none /mnt -o {share} "
    "&& sh /mnt/vm_service/guest.sh > /mnt/guest.log 2>&1; echo $? > /proc/exitcode"
)


def main() -> int:
    """Build the missing parts, boot, and evaluate the reports."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--deb", type=Path, help="the package (default: built now)")
    parser.add_argument("--image", type=Path, help="the disk (default: this week's, see vm_image)")
    parser.add_argument("--time-limit", type=float, default=600.0, help="seconds, whole run")
    parser.add_argument("--memory", default="768M", help="memory of the guest")
    parser.add_argument("--out", type=Path, help="folder for logs and junit.xml")
    parser.add_argument("tests", nargs="*", help="pytest arguments for tests/vm_service")
    given = parser.parse_args()
    absent = uml.missing(uml.UML)
    if absent:
        say("linux.uml not found: apt install user-mode-linux")
        return uml.CANNOT_START
    with tempfile.TemporaryDirectory(prefix="full-vm-") as scratch:
        work = Path(scratch)
        try:
            disk = given.image or vm_image.image()
        except debian_root.RootBuildError as error:
            say(str(error))
            return uml.CANNOT_START
        share = (given.out or work / "share").resolve()
        fill(share, given.deb or build_deb(work), given.tests)
        return run(work, disk.resolve(), share, given.memory, given.time_limit)


def build_deb(work: Path, *extra: str) -> Path:
    """Build the package of this checkout, and return its path."""
    say("building the package")
    words = [sys.executable, str(CHECKOUT / "packaging" / "deb.py"), "--out", str(work), *extra]
    done = subprocess.run(words, text=True, capture_output=True, check=False)  # noqa: S603 - ours
    if done.returncode:
        sys.exit(done.stdout + done.stderr)
    return Path(done.stdout.strip().splitlines()[-1])


def fill(share: Path, deb: Path, tests: list[str]) -> None:
    """Fill the folder that is shared with the guest; remove files of an earlier run."""
    share.mkdir(parents=True, exist_ok=True)
    for leftover in ("junit.xml", "pytest.log", "guest.log", "journal.txt", "console.log"):
        (share / leftover).unlink(missing_ok=True)
    shutil.rmtree(share / "vm_service", ignore_errors=True)
    shutil.copytree(TESTS, share / "vm_service", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copyfile(deb, share / "jointfitd.deb")
    make_newer(deb, share / "newer.deb")
    (share / "pytest.args").write_text("".join(f"{word}\n" for word in tests))


def make_newer(deb: Path, newer: Path) -> None:
    """Write the same package with a higher version, for the test of an upgrade."""
    with tempfile.TemporaryDirectory(prefix="newer-deb-") as scratch:
        tree = Path(scratch) / "tree"
        subprocess.run(["dpkg-deb", "-R", str(deb), str(tree)], check=True)  # noqa: S603, S607 - Debian's
        control = tree / "DEBIAN" / "control"
        text = control.read_text(encoding="utf-8")
        control.write_text(re.sub(r"(?m)^(Version: .*)$", r"\1.1", text), encoding="utf-8")
        words = [
            "dpkg-deb",
            "--root-owner-group",
            "-Zzstd",
            "-z1",
            "--build",
            str(tree),
            str(newer),
        ]
        subprocess.run(words, check=True, stdout=subprocess.DEVNULL)  # noqa: S603 - as above


def run(work: Path, disk: Path, share: Path, memory: str, limit_s: float) -> int:
    """Boot the machine; return the exit status."""
    service = START.format(no_result=uml.NO_RESULT, share=share)
    guest = uml.NO_AVX if uml.has_amx() else {}
    command = [
        uml.UML, f"mem={memory}", f"uml_dir={work}", f"ubd0={work}/cow,{disk}", "root=/dev/ubda",
        "rootfstype=ext4", "rw", *uml.CONSOLE, "systemd.show_status=0",
        *(f"systemd.mask={unit}" for unit in UNUSED),
        *(f"{name}={value}" for name, value in guest.items()),  # for PID 1
        *(f"systemd.setenv={name}={value}" for name, value in guest.items()),  # for other processes
        f"systemd.run=\"/bin/sh -c '{service}'\"",  # the quotes must reach the kernel
        "systemd.run_success_action=poweroff", "systemd.run_failure_action=poweroff",
    ]  # fmt: skip
    began = time.monotonic()
    with (share / "console.log").open("wb") as console:
        code = uml.boot(command, limit_s, console)
    say(f"the machine ended with {code} after {time.monotonic() - began:.1f} s")
    verdict = uml.judge(code, share / "junit.xml")
    if verdict:
        for name in ("guest.log", "pytest.log"):
            if (share / name).is_file():
                print((share / name).read_text(errors="replace")[-12000:])
    return verdict


if __name__ == "__main__":
    sys.exit(main())
