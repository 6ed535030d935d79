"""Run the numerical tests with the arithmetic of other processors: `make test-cpu`.

    .ci/cpu_features.py [--all] [PYTEST ARGUMENTS]

Kernels of OpenBLAS and loops of numpy round differently on each processor. If a decision in the
code depends on the last bits of a number, a test passes in one of these runs and fails in another.

A run has the kernels (``OPENBLAS_CORETYPE``) and the loops (``NPY_DISABLE_CPU_FEATURES``) of one
processor. The newest processor that this machine can imitate is omitted: `make test` covers it. A
processor whose instructions this machine cannot execute is skipped with its reason. After a
failure, or with ``--all``, more runs follow. Two of them combine the kernels of the oldest
processor with the loops of the newest, or the reverse. They show whether kernels or loops cause a
failure.

The exit status is 0 if every run passed, and 1 otherwise.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from dataclasses import dataclass
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
"""Tests of packages that compute with numpy. Plain Python rounds equally on all processors. It
computes, for example, the device clocks and the published poses."""


@dataclass(frozen=True)
class Processor:
    """A type of processor that OpenBLAS and numpy distinguish, or a combination of two types."""

    core_type: str
    """Name of the processor's kernels in OpenBLAS."""
    flag: str
    """Flag in /proc/cpuinfo that the kernels need."""
    steps: int | None
    """Number of numpy's feature levels above its baseline that this processor has; None for all
    levels of this machine."""


PROCESSORS = (
    Processor("Nehalem", "sse4_2", 0),
    Processor("Haswell", "avx2", 1),
    Processor("SkylakeX", "avx512f", None),
)
"""Processors of the first runs. They include each type of loop and each type of kernel."""
FURTHER = (
    Processor("Zen", "avx2", 1),
    Processor("Nehalem", "sse4_2", None),
    Processor("SkylakeX", "avx512f", 0),
)
"""Processors of the additional runs. Zen has the kernels of Haswell with other block sizes. The
other entries are not real processors: they combine the kernels of one with the loops of another."""


def main(arguments: list[str]) -> int:
    """Run the tests for all processors; print one line for each; return the exit status."""
    wants_all = "--all" in arguments
    tests = [word for word in arguments if word != "--all"] or TESTS
    flags = Path("/proc/cpuinfo").read_text(encoding="utf-8").split()

    failed = 0
    for processor in PROCESSORS:
        if processor.flag not in flags:
            print(f"{processor.core_type}: skipped, {processor.flag} is missing", flush=True)
        elif processor.steps is None and not wants_all:
            print(f"{processor.core_type}: omitted, `make test` runs on this processor", flush=True)
        else:
            failed += not _passes(processor, tests)

    if failed or wants_all:
        for processor in FURTHER:
            if processor.flag in flags:
                failed += not _passes(processor, tests)
    return 1 if failed else 0


def _passes(processor: Processor, tests: list[str]) -> bool:
    """Run the tests for one processor, and print the result; return whether all passed."""
    steps = [name for name in umath.__cpu_dispatch__ if umath.__cpu_features__[name]]
    disabled = [] if processor.steps is None else steps[processor.steps :]
    name = processor.core_type + (f" without {','.join(disabled)}" if disabled else "")

    began = time.monotonic()
    command = [
        sys.executable, "-m", "pytest", "-q", "-n", str(len(os.sched_getaffinity(0))),
        "--dist", "worksteal", "--part", "parallel", *tests,
    ]  # fmt: skip
    environment = os.environ | {
        "OPENBLAS_CORETYPE": processor.core_type,
        "NPY_DISABLE_CPU_FEATURES": ",".join(disabled),
        "HYPOTHESIS_PROFILE": "few",  # `make test` draws more examples
    }
    status = subprocess.run(command, check=False, env=environment).returncode  # noqa: S603 - ours

    outcome = "passed" if status == 0 else f"FAILED with {status}"
    print(f"{name}: {outcome} in {time.monotonic() - began:.0f} s", flush=True)
    return status == 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
