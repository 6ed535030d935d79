"""The worker process: one fit, started as ``python -m jointfit_daemon.supervisor.worker``.

Law: reads one pickled (kind, payload) from standard input, writes one pickled result to standard
output, ends. Pickle is safe here: both ends are this program, and the pipe is private to them.
"""

from __future__ import annotations

import os
import pickle  # noqa: S403 - parent and child only
import sys


def main() -> None:
    """Run one fit."""
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # the sensors need the other core
    from jointfit_daemon.calibration.jobs import run_job  # noqa: PLC0415 - after the environment

    kind, payload = pickle.load(sys.stdin.buffer)  # noqa: S301 - written by our parent
    result = run_job(kind, payload)
    sys.stdout.buffer.write(pickle.dumps(result))
    sys.stdout.buffer.flush()


if __name__ == "__main__":
    main()
