"""Accelerates the time of a daemon process; Python imports this module at its start.

The environment variable ENDURANCE contains the path of a file, the factor, and the instant at
which accelerated and real time agree, ns of CLOCK_MONOTONIC. The file receives the numbers of
asyncio tasks, of Python objects and of bytes that malloc has allocated.
"""

import asyncio
import ctypes
import gc
import mmap
import os
import selectors
import struct
import sys
import time
from pathlib import Path

_COUNTS = struct.Struct("<qqq")
_COUNT_S = 2.0
"""Real time between two counts, s. A count takes milliseconds."""


class _Mallinfo(ctypes.Structure):
    """Result of mallinfo2 of glibc."""

    _fields_ = tuple(
        (name, ctypes.c_size_t)
        for name in (
            *("arena", "ordblks", "smblks", "hblks", "hblkhd"),
            *("usmblks", "fsmblks", "uordblks", "fordblks", "keepcost"),
        )
    )


_mallinfo2 = ctypes.CDLL(None).mallinfo2
_mallinfo2.restype = _Mallinfo


def _allocated_bytes() -> int:
    """Return the size of all allocated blocks, without the free blocks of the resident memory."""
    found = _mallinfo2()
    return int(found.uordblks + found.hblkhd)


def _install(path: str, factor: int, begin_ns: int) -> None:
    real_ns, real_sleep, real_select = (
        time.monotonic_ns,
        time.sleep,
        selectors.EpollSelector.select,
    )
    unix_ns = time.time_ns() - real_ns()  # constant: a clock correction must not be multiplied

    def monotonic_ns() -> int:
        return begin_ns + (real_ns() - begin_ns) * factor

    time.monotonic_ns = monotonic_ns
    time.monotonic = lambda: monotonic_ns() * 1e-9
    time.time_ns = lambda: monotonic_ns() + unix_ns
    time.time = lambda: time.time_ns() * 1e-9
    time.sleep = lambda seconds: real_sleep(float(seconds) / factor)

    # The switch interval of threads remains the same in accelerated time.
    sys.setswitchinterval(sys.getswitchinterval() / factor)

    with Path(path).open("r+b") as file:
        shared = mmap.mmap(file.fileno(), _COUNTS.size)
    counted_ns = 0

    def select(self, timeout=None):  # type: ignore[no-untyped-def]
        nonlocal counted_ns
        if real_ns() - counted_ns > _COUNT_S * 1e9:
            counted_ns = real_ns()
            objects = len(gc.get_objects())
            _COUNTS.pack_into(shared, 0, len(asyncio.all_tasks()), objects, _allocated_bytes())
        wait_s = timeout / factor if timeout is not None and timeout > 0 else timeout
        return real_select(self, wait_s)

    selectors.EpollSelector.select = select  # type: ignore[method-assign]


if "ENDURANCE" in os.environ:
    _path, _factor, _begin_ns = os.environ["ENDURANCE"].rsplit(":", 2)
    _install(_path, int(_factor), int(_begin_ns))
