#!/usr/bin/env python3
"""Run tests on a kernel with SocketCAN, in a virtual machine that is an ordinary process.

    .ci/light_vm.py [--time-limit S] [--memory M] [--out DIR] [-- PYTEST ARGUMENTS]

Boots Debian's user-mode-linux (packages: user-mode-linux, iproute2) on the host's own files,
read-only, brings up vcan0 and runs ``pytest -m vm tests/vm`` with the Python that runs this script.
Nothing of the host can be written but DIR, which gets junit.xml.

Exit status: that of pytest; 1 if a test was skipped or none ran; 90 if the guest never got as far
as pytest's end; 124 at the time limit; 2 if the machine cannot be started at all.
"""

# ruff: noqa: S108 - the guest's folders are named, not used here

from __future__ import annotations

import argparse
import ctypes
import errno
import os
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[1]
UML = "linux.uml"
MODULES = Path("/usr/lib/uml/modules")
CAN_MODULES = (
    "net/can/can",
    "net/can/can-raw",
    "drivers/net/can/dev/can-dev",
    "drivers/net/can/vcan",
)
HIDDEN = ("/tmp", "/run", "/var/tmp", "/mnt")
"""Folders that the guest gets empty ones for; what it needs of them is mounted back."""
VOLATILE = "/var/tmp"  # holds the memory of the guest where /dev/shm is too small
PR_SET_SECCOMP, PR_SET_NO_NEW_PRIVS = 22, 38
NO_RESULT = 90
TIMED_OUT = 124
CANNOT_START = 2
PR_SET_PDEATHSIG = 1

NO_AVX = (
    "GLIBC_TUNABLES=glibc.cpu.hwcaps=-AVX,-AVX2,-AVX512F,-AVX512VL,-AVX512BW,"
    "-AVX_Fast_Unaligned_Load OPENBLAS_CORETYPE=Nehalem"
)
"""For a guest that keeps SSE registers only (see ``hide_xstate``)."""

INIT = """\
#!/bin/sh
# PID 1 of the guest. It must power off by itself: a PID 1 that returns is a kernel panic.
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
{python} {script} --guest-modules
ip link set lo up
ip link add dev vcan0 type vcan && ip link set vcan0 up && echo "light_vm: vcan0 is up"
{python} -m pytest --color=no -p no:cacheprovider --basetemp=/tmp/pytest \\
    --junitxml=/mnt/out/junit.xml {tests}
echo $? > /proc/exitcode
exec {python} -c 'import ctypes; ctypes.CDLL(None).reboot(0x4321fedc)'
"""


def say(text: str) -> None:
    """Tell what is done; flushed, for it mixes with the guest's console."""
    print(f"light_vm: {text}", flush=True)


def main() -> int:
    """Boot, run, judge."""
    given = arguments()
    if given.guest_modules:
        return load_modules()
    missing = [tool for tool in (UML, "ip") if shutil.which(tool, path=search_path()) is None]
    if missing:
        say(f"{', '.join(missing)} not found: apt install user-mode-linux iproute2")
        return CANNOT_START
    with tempfile.TemporaryDirectory(prefix="light-vm-") as scratch:
        work = Path(scratch)
        out = Path(given.out).resolve() if given.out else work / "out"
        out.mkdir(parents=True, exist_ok=True)
        (out / "junit.xml").unlink(missing_ok=True)
        write_init(work / "init", out, given.tests or ["-m", "vm", "tests/vm"])
        began = time.monotonic()
        code = boot(work, given.memory, given.time_limit)
        say(f"the machine ended with {code} after {time.monotonic() - began:.1f} s")
        return judge(code, out / "junit.xml")


def arguments() -> argparse.Namespace:
    """Return what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--time-limit", type=float, default=180.0, help="seconds, whole run")
    parser.add_argument("--memory", default="512M", help="memory of the guest")
    parser.add_argument("--out", help="folder for junit.xml (default: thrown away)")
    parser.add_argument("--guest-modules", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("tests", nargs="*", help="pytest arguments (default: -m vm tests/vm)")
    return parser.parse_args()


def search_path() -> str:
    """Return PATH with the folders of administration tools, which users often lack."""
    return os.environ.get("PATH", "") + ":/usr/sbin:/sbin"


def mounts(out: Path) -> list[str]:
    """Return the shell lines that hide the host's volatile folders and show what is needed."""
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
            say(f"mounting {path} back, read-only")
    lines.append("mkdir -p /mnt/out")
    lines.append(f"mount -t hostfs none /mnt/out -o {shlex.quote(str(out))}")
    return lines


def write_init(path: Path, out: Path, tests: list[str]) -> None:
    """Write PID 1 of the guest."""
    text = INIT.format(
        no_result=NO_RESULT,
        environment=NO_AVX if has_amx() else "LIGHT_VM=1",
        mounts="\n".join(mounts(out)),
        checkout=shlex.quote(str(CHECKOUT)),
        python=shlex.quote(sys.executable),
        script=shlex.quote(str(Path(__file__).resolve())),
        tests=shlex.join(tests),
    )
    path.write_text(text)
    path.chmod(0o755)
    say(f"checkout {CHECKOUT}, Python {sys.executable}, pytest {shlex.join(tests)}")


def boot(work: Path, memory: str, limit_s: float) -> int:
    """Run the machine to its end or the limit; nothing of it is left in any case."""
    command = [
        UML, f"mem={memory}", "rootfstype=hostfs", "rootflags=/", "ro", f"init={work / 'init'}",
        "con=null", "con0=null,fd:1", "panic=-1", "noreboot", "pty.legacy_count=0", "quiet",
        f"uml_dir={work}", "umid=light",
    ]  # fmt: skip
    environment = os.environ | {"PATH": search_path()}
    if shutil.disk_usage("/dev/shm").free < 1 << 29:  # guest memory lies there, or in TMPDIR
        environment["TMPDIR"] = VOLATILE
    if has_amx():
        say("the processor has AMX: hiding its extended state from UML")
    parent = os.getpid()
    machine = subprocess.Popen(  # noqa: S603 - a fixed command
        command, stdin=subprocess.DEVNULL, env=environment, cwd="/",
        preexec_fn=lambda: prepare(parent),  # noqa: PLW1509 - there are no threads here
    )  # fmt: skip
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: sys.exit(stop(machine) or 128 + signal.SIGTERM))
    say(f"booted as process {machine.pid}, at most {limit_s:g} s")
    try:
        return exit_status(machine.wait(limit_s))
    except subprocess.TimeoutExpired:
        say(f"not done after {limit_s:g} s: stopping it")
        return TIMED_OUT
    finally:
        stop(machine)


def prepare(parent: int) -> None:
    """In the child: one CPU (three times faster), and no life beyond this script's."""
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        os._exit(CANNOT_START)
    if has_amx():
        hide_xstate()


def has_amx() -> bool:
    """Whether the processor's extended state (11 KB) is larger than UML's room for it (2.7 KB)."""
    return " amx_tile " in Path("/proc/cpuinfo").read_text().replace("\n", " ")


def hide_xstate() -> None:
    """Have ``ptrace(PTRACE_GETREGSET)`` fail, so that UML saves registers the older way.

    UML 6.1 tries that call at boot to see whether it can save the extended state. On a processor
    with AMX the try succeeds and every later PTRACE_SETREGSET fails, for its buffer is too short:
    the guest dies at once ("ptrace set fp regs failed, errno = 14"). Refused, it falls back to
    PTRACE_GETFPREGS: x87 and SSE only, which is why threads of the guest must do without AVX.
    """
    load, equal, ret = 0x20, 0x15, 0x06
    program = struct.pack(
        "HBBI" * 6,
        load, 0, 0, 0,  # system call number
        equal, 0, 3, 101,  # ptrace
        load, 0, 0, 16,  # its first argument
        equal, 0, 1, 0x4204,  # PTRACE_GETREGSET
        ret, 0, 0, 0x00050000 | errno.EINVAL,  # fails
        ret, 0, 0, 0x7FFF0000,  # all else is allowed
    )  # fmt: skip
    room = ctypes.create_string_buffer(program)
    header = struct.pack("HxxxxxxP", 6, ctypes.addressof(room))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.prctl(PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) or libc.prctl(PR_SET_SECCOMP, 2, header, 0, 0):
        os.write(2, b"light_vm: cannot filter system calls\n")
        os._exit(CANNOT_START)


def stop(machine: subprocess.Popen[bytes]) -> int:
    """End the machine: ask, then kill its process group, which is its own. Return 0."""
    if machine.poll() is None:
        machine.terminate()
        try:
            machine.wait(10)
        except subprocess.TimeoutExpired:
            machine.kill()
            machine.wait()
    for _ in range(100):  # it calls setsid: whatever is left is in its group
        try:
            os.killpg(machine.pid, signal.SIGKILL)
        except (ProcessLookupError, PermissionError):
            return 0
        time.sleep(0.05)
    say(f"process group {machine.pid} does not die")
    return 0


def exit_status(code: int) -> int:
    """Return a signal's death as shells do."""
    return code if code >= 0 else 128 - code


def judge(code: int, report: Path) -> int:
    """Return the exit status: pytest's, unless the report says less was tested than asked."""
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
    if code == 0 and (counts["skipped"] or not counts["tests"]):
        say("skipped tests, or none at all: nothing may be skipped here")
        return 1
    return code or int(bool(counts["failures"] or counts["errors"]))


def load_modules() -> int:
    """In the guest: load the CAN modules without kmod."""
    libc = ctypes.CDLL(None, use_errno=True)
    for name in CAN_MODULES:
        path = MODULES / os.uname().release / "kernel" / f"{name}.ko"
        descriptor = os.open(path, os.O_RDONLY)
        if libc.syscall(313, descriptor, b"", 0):  # finit_module, x86-64
            say(f"{name}: {os.strerror(ctypes.get_errno())}")
        os.close(descriptor)
    return 0


if __name__ == "__main__":
    sys.exit(main())
