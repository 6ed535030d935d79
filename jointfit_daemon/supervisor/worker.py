"""The worker process, which runs one fit: ``python -m jointfit_daemon.supervisor.worker``.

The worker reads a pickled job from standard input and writes JSON objects, one per line. It writes
any number of ``{"progress": …, "text": …}``, at most five a second, and then ``{"result": …}`` or
``{"error": text}``. Everything else that a fit prints is redirected to standard error. The parent
process leaves the input open, and the worker exits when the input is closed.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import struct
import sys
import threading
import time
import traceback
from typing import TYPE_CHECKING

import orjson

if TYPE_CHECKING:
    from jointfit_daemon.calibration import JobControl

HEADER = struct.Struct("<Q")
"""Format of the length of the pickled job, in bytes."""
_REPORT_S = 0.2
"""Shortest time between two reports of progress, s."""
_NICE = 10
"""Increase of the nice value, because acquisition has precedence."""


def main() -> int:
    """Run the job that the parent process sends."""
    with contextlib.suppress(OSError):  # a system-call filter may refuse this
        os.nice(_NICE)
    answer_fd = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())

    source = sys.stdin.buffer
    (length,) = HEADER.unpack(source.read(HEADER.size))
    data = source.read(length)
    threading.Thread(target=_exit_with_parent, daemon=True).start()

    try:
        from jointfit_daemon.calibration.phases import run_job  # noqa: PLC0415 - errors are answers

        job = pickle.loads(data)  # noqa: S301 - written by our parent
        answer: dict[str, object] = {"result": run_job(job, _control(answer_fd)).to_dict()}
    except Exception as error:  # noqa: BLE001 - the parent reports it
        traceback.print_exc()
        answer = {"error": f"{type(error).__name__}: {error}"}

    with os.fdopen(answer_fd, "wb") as output:
        output.write(orjson.dumps(answer, option=orjson.OPT_SERIALIZE_NUMPY))
    return 0


def _control(answer_fd: int) -> JobControl:
    """Return an object that measures the time from now on and reports progress to a descriptor."""
    from jointfit_daemon.calibration import JobControl  # noqa: PLC0415 - as above

    began = reported = time.monotonic()

    def report(share: float, text: str) -> None:
        nonlocal reported
        if (now := time.monotonic()) - reported >= _REPORT_S:
            reported = now
            os.write(answer_fd, orjson.dumps({"progress": share, "text": text}) + b"\n")

    return JobControl(lambda: time.monotonic() - began, report)


def _exit_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)  # the lock of the buffered reader would delay a normal end
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
