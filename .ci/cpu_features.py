"""Run the numerical tests as on other processors: `make test-cpu`.

    .ci/cpu_features.py [PYTEST ARGUMENTS]

Kernels of OpenBLAS and loops of numpy round differently on each processor. A decision that
depends on last bits shows itself by a test that passes in one of these runs and fails in another.
The runs differ in ``OPENBLAS_CORETYPE`` and ``NPY_DISABLE_CPU_FEATURES``. A run that this processor
cannot execute is skipped with its reason.

Exit status: 0 if every run passed, 1 otherwise.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

from numpy._core import _multiarray_umath as umath  # type: ignore[attr-defined]  # no stub

TESTS = [
    f"tests/{name}"
    for name in (
        "timing/lag", "timing/alignment", "kinematics", "center_of_rotation", "limb_model",
        "fusion", "calibration", "pipeline/calibration_session", "pipeline/online_learning",
        "pipeline/sources",
    )
]  # fmt: skip
"""Tests of packages that compute with numpy. Plain Python, such as the device clocks and the frames
of the core, rounds alike on all processors."""
CORE_TYPES = {"Nehalem": "sse4_2", "Haswell": "avx2", "SkylakeX": "avx512f", "Zen": "avx2"}
"""Kernels of OpenBLAS, and the flag of /proc/cpuinfo that a processor needs for them."""


def main(arguments: list[str]) -> int:
    """Run all; print a line for each; return the exit status."""
    flags = Path("/proc/cpuinfo").read_text(encoding="utf-8").split()
    failed = 0
    for name, text, flag in _runs():
        if flag not in flags:
            print(f"{name}={text}: skipped, this processor lacks {flag}", flush=True)
            continue
        began = time.monotonic()
        command = [
            sys.executable, "-m", "pytest", "-q", "-n", str(len(os.sched_getaffinity(0))),
            "--dist", "worksteal", "--part", "parallel",
            *(arguments or TESTS),
        ]  # fmt: skip
        environment = os.environ | {name: text, "HYPOTHESIS_PROFILE": "few"}  # `make test` has all
        status = subprocess.run(  # noqa: S603 - our own command
            command, check=False, env=environment
        ).returncode
        failed += status != 0
        outcome = "passed" if status == 0 else f"FAILED with {status}"
        print(f"{name}={text}: {outcome} in {time.monotonic() - began:.0f} s", flush=True)
    return 1 if failed else 0


def _runs() -> list[tuple[str, str, str]]:
    """Return variable, value, and the processor's flag that the run needs."""
    found = [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__[name]]
    every = next(iter(CORE_TYPES.values()))
    return [
        *(("OPENBLAS_CORETYPE", core, flag) for core, flag in CORE_TYPES.items()),
        ("NPY_DISABLE_CPU_FEATURES", ",".join(found), every),  # the baseline only
        ("NPY_DISABLE_CPU_FEATURES", ",".join(found[1:]), every),  # and the first step above it
    ]


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
