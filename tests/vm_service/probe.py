"""Program that the unit starts instead of the daemon; it tries operations that the unit restricts.

It prints one JSON object with the errno of every operation, or 0 if the operation succeeded.
"""

from __future__ import annotations

import ctypes
import json
import mmap
import os
import socket
import sys
import time
from pathlib import Path

PORT = sys.argv[1]
LIBC = ctypes.CDLL(None, use_errno=True)


def tried(attempt: object) -> int:
    """Return the errno of an operation, 0 if it succeeded."""
    try:
        attempt()  # type: ignore[operator]
    except OSError as error:
        return error.errno or -1
    return 0


def call(number: int, *arguments: int) -> int:
    """Return the errno of a system call, 0 if it succeeded."""
    ctypes.set_errno(0)
    return ctypes.get_errno() if LIBC.syscall(number, *arguments) == -1 else 0


def write(path: str) -> int:
    return tried(lambda: Path(path).write_text("x"))


def packet(address: str) -> int:
    """Return the errno of sending a datagram to `address`, to which the machine has a route."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as speaker:
        return tried(lambda: speaker.sendto(b"x", (address, 1511)))


def capabilities() -> str:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(line.split()[1] for line in lines if line.startswith("CapEff"))


SHMGET, ADD_KEY, IO_URING_SETUP, PROCESS_VM_READV = 29, 248, 425, 310
UNSHARE, MOUNT, SETHOSTNAME, CLOCK_SETTIME, PTRACE = 272, 165, 170, 227, 101
found = {
    "write /usr": write("/usr/probe"),
    "write /etc": write("/etc/probe"),
    "write /etc/jointfitd": write("/etc/jointfitd/probe"),
    "write /var/lib": write("/var/lib/probe"),
    "write /opt": write("/opt/probe"),
    "read /home": tried(lambda: list(Path("/home").iterdir())),
    "read /root": tried(lambda: list(Path("/root").iterdir())),
    "open /dev/kmsg": tried(lambda: os.open("/dev/kmsg", os.O_RDONLY)),
    "open /dev/net/tun": tried(lambda: os.open("/dev/net/tun", os.O_RDWR)),
    "open a disk": tried(lambda: os.open("/dev/ubda", os.O_RDONLY)),
    "raw socket": tried(lambda: socket.socket(socket.AF_INET, socket.SOCK_RAW, 1)),
    "packet socket": tried(lambda: socket.socket(socket.AF_PACKET, socket.SOCK_RAW, 0)),
    "netlink socket": tried(lambda: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, 0)),
    "own namespace": call(UNSHARE, 0x00020000),
    "mount": call(MOUNT, 0, 0, 0, 0, 0),
    "host name": call(SETHOSTNAME, 0, 0),
    "clock": call(CLOCK_SETTIME, 0, 0),
    "ptrace": call(PTRACE, 16, 1, 0, 0),
    "shared memory": call(SHMGET, 0, 4096, 0o1600),
    "keyring": call(ADD_KEY, 0, 0, 0, 0, 0),
    "io_uring": call(IO_URING_SETUP, 1, 0),
    "memory of processes": call(PROCESS_VM_READV, os.getpid(), 0, 0, 0, 0, 0),
    "code that can be written": tried(
        lambda: mmap.mmap(-1, 4096, prot=mmap.PROT_WRITE | mmap.PROT_EXEC)
    ),
    "new capability": 0 if int(capabilities(), 16) else 1,
    "setuid": tried(lambda: os.setuid(0)),
    "public network": packet("198.51.100.7"),
    # operations that the unit must permit
    "may write its state": write(os.environ["STATE_DIRECTORY"] + "/probe"),
    "may open its port": tried(lambda: os.open(PORT, os.O_RDWR | os.O_NOCTTY)),
    "may speak CAN": tried(lambda: socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)),
    "may speak to 10.x": packet("10.77.0.7"),
    "may speak to 192.168.x": packet("192.168.77.7"),
    "may speak to cameras by multicast": packet("239.255.42.99"),
    "may speak UDP": tried(lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM)),
}
print("PROBE " + json.dumps(found), flush=True)
notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
address = os.environ["NOTIFY_SOCKET"]
notify.sendto(b"READY=1", "\0" + address[1:] if address.startswith("@") else address)
time.sleep(30)
