"""A Linux kernel as an ordinary process (Debian's user-mode-linux, UML), with clean start and end.

Invariant: no process of a machine outlives the script that booted it. A result counts only if the
guest wrote it. The root of the guest is the file system of the host (``light_vm.py``) or a disk
image with systemd (``full_vm.py``).
"""

from __future__ import annotations

import ctypes
import errno
import os
import shutil
import signal
import struct
import subprocess
import sys
import time
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import IO

UML = "linux.uml"
MODULES = Path("/usr/lib/uml/modules")
VOLATILE = "/var/tmp"  # noqa: S108 - holds the memory of the guest if /dev/shm is too small
PR_SET_SECCOMP, PR_SET_NO_NEW_PRIVS = 22, 38
PR_SET_PDEATHSIG = 1
NO_RESULT = 90
TIMED_OUT = 124
CANNOT_START = 2
CONSOLE = ("con=null", "con0=null,fd:1", "panic=-1", "noreboot", "pty.legacy_count=0")

NO_AVX = {
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX,-AVX2,-AVX512F,-AVX512VL,-AVX512BW,"
    "-AVX_Fast_Unaligned_Load",
    "OPENBLAS_CORETYPE": "Nehalem",
    "NPY_DISABLE_CPU_FEATURES": "X86_V3,X86_V4,AVX512_ICL,AVX512_SPR",
}
"""Environment variables for every program of a guest whose kernel saves no AVX registers (see
``hide_xstate``)."""


def say(text: str) -> None:
    """Print one line and flush it, because the guest's console uses the same output."""
    print(f"{Path(sys.argv[0]).stem}: {text}", flush=True)


def search_path() -> str:
    """Return PATH extended by the folders of administration tools, which users often lack."""
    return os.environ.get("PATH", "") + ":/usr/sbin:/sbin"


def missing(*tools: str) -> list[str]:
    """Return the programs that are not installed."""
    return [tool for tool in tools if shutil.which(tool, path=search_path()) is None]


def boot(command: list[str], limit_s: float, console: IO[bytes] | None = None) -> int:
    """Run a machine to its end or to the time limit; stop all its processes.

    Return the guest's exit status, 128 + the number of a signal, or `TIMED_OUT`.
    """
    machine = start(command, console)
    say(f"booted as process {machine.pid}, at most {limit_s:g} s")
    try:
        return exit_status(machine.wait(limit_s))
    except subprocess.TimeoutExpired:
        say(f"not done after {limit_s:g} s: stopping it")
        return TIMED_OUT
    finally:
        stop(machine)


def start(command: list[str], console: IO[bytes] | int | None = None) -> subprocess.Popen[bytes]:
    """Start a machine, which ends with this script; `stop` ends it earlier."""
    environment = os.environ | {"PATH": search_path()}
    if shutil.disk_usage("/dev/shm").free < 1 << 29:  # noqa: S108 - guest memory lies there
        environment["TMPDIR"] = VOLATILE
    if has_amx():
        say("the processor has AMX: hiding its extended state from UML")
    parent = os.getpid()
    machine = subprocess.Popen(  # noqa: S603 - a fixed command
        command, stdin=subprocess.DEVNULL, stdout=console, env=environment, cwd="/",
        stderr=None if console is None else subprocess.STDOUT,
        preexec_fn=lambda: prepare(parent),  # noqa: PLW1509 - there are no threads here
    )  # fmt: skip
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: sys.exit(stop(machine) or 128 + signal.SIGTERM))
    return machine


def prepare(parent: int) -> None:
    """Prepare the child process: use one CPU (three times faster), and end with this script."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        os._exit(CANNOT_START)
    if has_amx():
        hide_xstate()


def has_amx() -> bool:
    """Return whether the processor's extended state (11 KB) exceeds UML's buffer (2.7 KB)."""
    return " amx_tile " in Path("/proc/cpuinfo").read_text().replace("\n", " ")


def hide_xstate() -> None:
    """Make ``ptrace(PTRACE_GETREGSET)`` fail, so UML saves registers the older way.

    At boot, UML 6.1 tests with this call whether it can save the extended state. On a processor
    with AMX, the test succeeds. Every later PTRACE_SETREGSET then fails because its buffer is too
    short, and the guest dies at once ("ptrace set fp regs failed, errno = 14"). If the call fails,
    UML uses PTRACE_GETFPREGS, which saves x87 and SSE registers only. Threads of the guest must
    therefore not use AVX.
    """
    load, equal, ret = 0x20, 0x15, 0x06
    program = struct.pack(
        "HBBI" * 6,
        load, 0, 0, 0,  # system call number
        equal, 0, 3, 101,  # ptrace
        load, 0, 0, 16,  # its first argument
        equal, 0, 1, 0x4204,  # PTRACE_GETREGSET
        ret, 0, 0, 0x00050000 | errno.EINVAL,  # the call fails
        ret, 0, 0, 0x7FFF0000,  # all other calls are allowed
    )  # fmt: skip
    room = ctypes.create_string_buffer(program)
    header = struct.pack("HxxxxxxP", 6, ctypes.addressof(room))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) or libc.prctl(PR_SET_SECCOMP, 2, header, 0, 0):
        os.write(2, b"light_vm: cannot filter system calls\n")
        os._exit(CANNOT_START)


def stop(machine: subprocess.Popen[bytes]) -> int:
    """Terminate the machine, then kill its process group. Return 0."""
    if machine.poll() is None:
        machine.terminate()
        try:
            machine.wait(10)
        except subprocess.TimeoutExpired:
            machine.kill()
            machine.wait()
    for _ in range(100):  # the machine calls setsid, so all its processes are in its group
        try:
            os.killpg(machine.pid, signal.SIGKILL)
        except (ProcessLookupError, PermissionError):
            break
        time.sleep(0.05)
    if left := members(machine.pid):
        sys.exit(f"processes of the machine are left: {left}")
    return 0


def members(group: int) -> list[int]:
    """Return the processes of a process group that have not ended; zombies have ended."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, of_group = path.read_text().rpartition(")")[2].split()[:3]
        except (OSError, ValueError):  # the process has just ended
            continue
        if int(of_group) == group and state != "Z":
            found.append(int(path.parent.name))
    return found


def exit_status(code: int) -> int:
    """Return the exit status in the convention of shells: 128 + N after a signal N."""
    return code if code >= 0 else 128 - code


NOT_OF_THIS_WIRE = ("this wire", "bytes of this wire")
"""First words of the reasons with which the conformance suite skips tests."""


def judge(code: int, report: Path) -> int:
    """Return pytest's status; 1 if a test was skipped or none ran; `NO_RESULT` without report."""
    if code == TIMED_OUT:
        return code
    if not report.is_file():
        say("no junit.xml: the tests did not run to their end")
        return code or NO_RESULT
    suites = list(ET.parse(report).getroot().iter("testsuite"))  # noqa: S314 - our own pytest's
    counts = {
        key: sum(int(suite.get(key, 0)) for suite in suites)
        for key in ("tests", "failures", "errors", "skipped")
    }
    say(", ".join(f"{key} {value}" for key, value in counts.items()))

    # Only tests that the protocol excludes may be skipped here.
    reasons = [
        found.get("message") or "no reason given"
        for suite in suites
        for found in suite.iter("skipped")
    ]
    wrong = sorted({reason for reason in reasons if not reason.startswith(NOT_OF_THIS_WIRE)})
    if code == 0 and (wrong or not counts["tests"]):
        say(f"skipped tests, or none at all: {', '.join(wrong) or 'no test ran'}")
        return 1
    return code or int(bool(counts["failures"] or counts["errors"]))
