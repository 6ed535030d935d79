#!/usr/bin/env python3
"""Cut the power of a virtual machine that records to ext4, and read the recordings on its disk.

    .ci/power_cut.py [--cuts N] [--seed N] [--time-limit S]

The light virtual machine records four sensors at 400 Hz to its own disk. At N random times, the
machine is paused and its disk is copied. At the last of these times, the machine is also killed.
A copied disk contains the data that the guest had written, without the pages in its memory. A
second machine mounts these disks, so that their journals are replayed, and copies the recordings to
the host.

Invariant: every recording can be opened. It lacks at most the last second before the cut.

The exit status is 0 if the invariant holds, and 1 otherwise. Other values are those of
``light_vm.py``.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from itertools import pairwise
from pathlib import Path
from string import ascii_lowercase
from threading import Thread
from typing import NamedTuple

import light_vm
import uml
from uml import say

from jointfit_daemon.outputs.recording import RecordedMessage, open_recording

DISK_MIB = 16
DISKS = "/dev/shm"  # noqa: S108 - memory: a busy disk of the host would delay the guest
LONGEST_LOSS_S = 1.0
"""Longest accepted loss if no other load of the host delays the guest, s."""
STAMP_S = 0.1
"""Time between two stamps, s. A stamp is the arrival time of a chunk, which the guest prints. A
longer time is caused by the load of this machine."""
FILE_S = 2.0
"""Duration of one file, s. It exceeds `LONGEST_LOSS_S`, so the loss of a file would fail the test.
It is shorter than `RECORDED_S`, so some cuts can occur at the beginning of a file."""
RECORDED_S = 6.0
"""Period in which the power cuts occur, s."""
RECORD = """\
mkdir /tmp/disk && mount -t ext4 /dev/ubda /tmp/disk && exec {python} -m \\
    bench.rigs.recording_process /tmp/disk/recordings --file-seconds {file_s} --stamps
"""
HAND_OVER = """\
mkdir /tmp/disk
status=0
for disk in {disks}; do
  mount -t ext4 /dev/ubd$disk /tmp/disk && cp -r /tmp/disk/recordings /mnt/out/$disk \\
      && umount /tmp/disk || status=1
done
echo $status > /proc/exitcode
"""


class RecordingMachine:
    """A machine that records to its disk."""

    def __init__(self, work: Path, disk: Path) -> None:
        self.stamps_ns: list[int] = []
        """Arrival times of some chunks in the guest, CLOCK_MONOTONIC of the guest, ns."""
        self.console: list[str] = []
        self._disk = disk
        with self._disk.open("wb") as file:
            file.truncate(DISK_MIB << 20)
        mke2fs = shutil.which("mke2fs", path=uml.search_path())
        subprocess.run([str(mke2fs), "-q", "-t", "ext4", str(self._disk)], check=True)  # noqa: S603 - ours

        light_vm.write_init(work / "init", work / "out", RECORD, file_s=str(FILE_S))
        command = light_vm.machine_command(work, "256M", f"ubd0={self._disk}")
        self._machine = uml.start(command, subprocess.PIPE)
        Thread(target=self._read_console, daemon=True).start()

    def _read_console(self) -> None:
        for line in self._machine.stdout or ():
            text = line.decode(errors="replace").strip()
            if text.isdigit():
                self.stamps_ns.append(int(text))
            else:
                self.console.append(text)

    def wait_for_recording(self, limit_s: float) -> bool:
        """Wait for the first stamp; return whether there is one."""
        until_s = time.monotonic() + limit_s
        while not self.stamps_ns and self._machine.poll() is None and time.monotonic() < until_s:
            time.sleep(0.01)
        return bool(self.stamps_ns)

    def copy_disk(self, target: Path) -> list[int]:
        """Copy the disk in the state after a power cut; return the stamps of the guest."""
        stopped = [one for one in uml.members(self._machine.pid) if not is_traced(one)]
        for process in stopped:
            os.kill(process, signal.SIGSTOP)
        for process in stopped:
            while process_state(process) not in "Tt":
                time.sleep(0.001)
        shutil.copyfile(self._disk, target)
        stamps_ns = self.stamps_ns.copy()
        for process in stopped:
            os.kill(process, signal.SIGCONT)
        return stamps_ns

    def kill(self) -> Path:
        """Kill the machine; return the path of its disk."""
        with suppress(ProcessLookupError):
            os.killpg(self._machine.pid, signal.SIGKILL)
        uml.stop(self._machine)
        return self._disk


def is_traced(process: int) -> bool:
    """Return whether a process belongs to the guest, whose kernel traces all its processes."""
    status = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    return "\nTracerPid:\t0\n" not in status


def process_state(process: int) -> str:
    """Return the state letter of a process; ``T`` means stopped."""
    return Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(") ")[2][0]


def main() -> int:
    """Record, cut the power, mount the disks, and read the recordings."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--cuts", type=int, default=6, choices=range(1, 16), metavar="N")
    parser.add_argument("--seed", type=int, default=random.randrange(1000))  # noqa: S311 - moments of a test
    parser.add_argument("--time-limit", type=float, default=120.0, help="seconds, each machine")
    given = parser.parse_args()
    absent = uml.missing(uml.UML, "mke2fs")
    if absent:
        say(f"{', '.join(absent)} not found: apt install user-mode-linux e2fsprogs")
        return uml.CANNOT_START

    drawn = random.Random(given.seed)  # noqa: S311 - as above
    period_s = RECORDED_S / given.cuts
    moments_s = [drawn.uniform(number, number + 1) * period_s for number in range(given.cuts)]
    say(f"seed {given.seed}, cuts after {', '.join(f'{each:.2f}' for each in moments_s)} s")
    with (
        tempfile.TemporaryDirectory(prefix="power-cut-") as scratch,
        tempfile.TemporaryDirectory(prefix="power-cut-", dir=DISKS) as memory,
    ):
        work = Path(scratch)
        (work / "out").mkdir()
        disks = cut_power(work, Path(memory), moments_s, given.time_limit)
        code = hand_over(work, [each.disk for each in disks], given.time_limit) if disks else 1
        if code:
            say("no recording was made, or its disk cannot be mounted")
            return code
        results = [
            judge(work / "out" / letter, each)
            for letter, each in zip(ascii_lowercase, disks, strict=False)
        ]
    return int(not all(results))


class CutDisk(NamedTuple):
    """A disk after a power cut."""

    disk: Path
    stamps_ns: list[int]
    """Known arrival times of chunks before the cut, CLOCK_MONOTONIC of the guest, ns."""


def cut_power(work: Path, memory: Path, moments_s: list[float], limit_s: float) -> list[CutDisk]:
    """Record on a machine; return its disk at each cut, or no disks if it does not record."""
    machine = RecordingMachine(work, memory / "disk")
    try:
        if not machine.wait_for_recording(limit_s):
            print("\n".join(machine.console))
            return []
        began_s, found = time.monotonic(), []
        for number, moment_s in enumerate(moments_s[:-1]):
            time.sleep(max(0.0, began_s + moment_s - time.monotonic()))
            disk = memory / f"disk-{number}"
            found.append(CutDisk(disk, machine.copy_disk(disk)))
        time.sleep(max(0.0, began_s + moments_s[-1] - time.monotonic()))
    finally:
        disk = machine.kill()
    return [*found, CutDisk(disk, machine.stamps_ns)]


def hand_over(work: Path, disks: list[Path], limit_s: float) -> int:
    """Mount the disks in a machine that copies the recordings to the host; return its status."""
    letters = ascii_lowercase[: len(disks)]
    light_vm.write_init(work / "init", work / "out", HAND_OVER, disks=" ".join(letters))
    attached = [f"ubd{number}={disk}" for number, disk in enumerate(disks)]
    return uml.boot(light_vm.machine_command(work, "128M", *attached), limit_s)


def judge(folder: Path, cut: CutDisk) -> bool:
    """Print the losses of a recording; return whether at most its last second is missing."""
    recording = open_recording(folder)
    messages = list(recording.messages())
    found = [one for one in messages if isinstance(one, RecordedMessage)]
    arrivals_ns = [one.t_ns for one in found if one.channel.startswith("source/")]
    lost_s = (cut.stamps_ns[-1] - max(arrivals_ns, default=cut.stamps_ns[0])) * 1e-9
    late_s = max(b - a for a, b in pairwise([cut.stamps_ns[0], *cut.stamps_ns])) * 1e-9 - STAMP_S
    gaps = len(messages) - len(found)
    unfinished = sum(each.path.suffix == ".part" for each in recording.parts)
    late_s = max(late_s, 0.0)
    say(
        f"{len(found)} messages in files 1 to {recording.parts[-1].info.part}, {unfinished} "
        f"unfinished; lost {max(lost_s, 0.0):.2f} s, {gaps} gaps; stamps up to {late_s:.2f} s late"
    )
    return recording.info.part == 1 and not gaps and lost_s <= LONGEST_LOSS_S + late_s


if __name__ == "__main__":
    sys.exit(main())
