"""The worker process: one fit, started as ``python -m jointfit_daemon.supervisor.worker``.

The worker reads a pickled (kind, payload) from standard input and writes one JSON object:
``{"result": …}`` or ``{"error": text}``; both ends are this program. What the fit prints goes to
standard error. The parent keeps its end of the input open: when that closes, the worker dies.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import struct
import sys
import threading
import traceback

import orjson

HEADER = struct.Struct("<Q")
"""Length of what follows."""
_NICE = 10  # the samples come first


def main() -> int:
    """Run the one job that the parent sends."""
    with contextlib.suppress(OSError):  # refused under a system-call filter
        os.nice(_NICE)
    answer_fd = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    source = sys.stdin.buffer
    (length,) = HEADER.unpack(source.read(HEADER.size))
    words = source.read(length)
    threading.Thread(target=_die_with_parent, daemon=True).start()
    try:
        from jointfit_daemon.calibration.phases import run_job  # noqa: PLC0415 - its fault is an answer

        kind, payload = pickle.loads(words)  # noqa: S301 - written by our parent
        answer: dict[str, object] = {"result": run_job(kind, payload)}
    except Exception as error:  # noqa: BLE001 - the parent tells it
        traceback.print_exc()
        answer = {"error": f"{type(error).__name__}: {error}"}
    with os.fdopen(answer_fd, "wb") as output:
        output.write(orjson.dumps(answer, option=orjson.OPT_SERIALIZE_NUMPY))
    return 0


def _die_with_parent() -> None:
    os.read(sys.stdin.fileno(), 1)  # not the buffered reader: its lock would hold up a normal end
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main())
