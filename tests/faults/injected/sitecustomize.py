"""Faults of the host in a daemon process: Python imports this module at its start.

A real step of UNIX time would reach every process of the machine, and a slow disk needs a device
of its own. The environment variable INJECTED_FAULTS names a file with the step of UNIX time, ns,
and the delay of a durable write, s.
"""

import mmap
import os
import struct
import time
from collections.abc import Callable
from pathlib import Path

_FAULTS = struct.Struct("<qd")
_WRITES = ("fsync", "fdatasync")


def _install() -> None:
    with Path(os.environ["INJECTED_FAULTS"]).open("r+b") as file:
        shared = mmap.mmap(file.fileno(), _FAULTS.size)

    real_ns = time.time_ns
    time.time_ns = lambda: real_ns() + _FAULTS.unpack_from(shared)[0]
    time.time = lambda: time.time_ns() * 1e-9
    for name in _WRITES:
        setattr(os, name, _delayed(getattr(os, name), shared))


def _delayed(write: Callable[[int], None], shared: mmap.mmap) -> Callable[[int], None]:
    def delayed(descriptor: int) -> None:
        time.sleep(_FAULTS.unpack_from(shared)[1])
        write(descriptor)

    return delayed


if "INJECTED_FAULTS" in os.environ:
    _install()
