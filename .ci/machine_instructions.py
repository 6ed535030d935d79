"""Count the instructions that compute one output frame on x86-64 and on arm64, in QEMU.

    .ci/machine_instructions.py CALIBRATION

QEMU's user emulation runs Debian's Python of each architecture. Python runs
``bench.rigs.core_frames`` with the pure wheel of this checkout and the libraries of
requirements.lock. The count is the difference between a long and a short run, so it does not
contain the start of Python. `CALIBRATION` is a file with a calibration of the simulated subject.

The result on standard output is JSON: the mean number of instructions per frame, by architecture.
The exit status is 2 if a tool or a system is missing.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from arm_root import MACHINES, install
from debian_root import CACHE, SUITE, RootBuildError, bootstrap, kept, require, run

CHECKOUT = Path(__file__).resolve().parents[1]
PACKAGES = ("python3", "libstdc++6")
TOOLS = {
    "cc": "gcc",
    "mmdebstrap": "mmdebstrap",
    "qemu-aarch64": "qemu-user",
    "qemu-aarch64-static": "qemu-user-static binfmt-support",
    "arch-test": "arch-test",
}
"""Programs, each with its Debian package. mmdebstrap needs `qemu-aarch64-static`."""
SHORT, LONG = 300, 1300
"""Number of frames of the two runs."""


def interpreter_root(architecture: str) -> Path:
    """Return an archive with Debian's Python, which is made once a week."""
    return kept(
        f"interpreter-{architecture}.tar",
        " ".join(PACKAGES),
        TOOLS,
        lambda work: bootstrap(PACKAGES, (), work, SUITE, architecture),
    )


def build_wheel(work: Path) -> Path:
    """Build the pure wheel of this checkout; return its path."""
    run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(work)], CHECKOUT)
    (wheel,) = work.glob("*.whl")
    return wheel


def build_plugin(work: Path) -> Path:
    """Compile the plugin of QEMU that counts instructions; return its path."""
    plugin = work / "count_instructions.so"
    source = CHECKOUT / ".ci" / "count_instructions.c"
    run(["cc", "-O2", "-shared", "-fPIC", "-o", str(plugin), str(source)], work)
    return plugin


def count(machine: str, root: Path, path: str, plugin: Path, words: list[str]) -> int:
    """Return the number of instructions that Python executes with the arguments `words`."""
    done = subprocess.run(  # noqa: S603 - fixed commands
        [
            f"qemu-{machine}", "-plugin", str(plugin), "-L", str(root),
            str(root / "usr" / "bin" / "python3"), *words,
        ],
        env=os.environ
        | {
            "PYTHONPATH": path,
            "PYTHONHASHSEED": "0",
            "PYTHONDONTWRITEBYTECODE": "1",
            "OPENBLAS_NUM_THREADS": "1",
        },
        cwd=root, text=True, capture_output=True, check=False,
    )  # fmt: skip
    last = done.stderr.strip().rpartition("\n")[2]
    if done.returncode or not last.startswith("instructions "):
        raise RootBuildError(f"{machine}: Python ended with {done.returncode}:\n{done.stderr}")
    return int(last.split()[1])


def main() -> int:
    """Print the instructions per frame by architecture; return the exit status."""
    calibration = str(Path(sys.argv[1]).resolve())
    found = {}
    try:
        require(TOOLS)
        CACHE.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix="instructions-", dir=CACHE) as name:
            work = Path(name)
            wheel, plugin = build_wheel(work), build_plugin(work)
            for architecture, machine in MACHINES.items():
                root, libraries = work / architecture, work / f"{architecture}-libraries"
                root.mkdir()
                archive = str(interpreter_root(architecture))
                run(["tar", "-xf", archive, "--exclude=./dev/*", "-C", str(root)], work)
                install([str(wheel)], architecture, SUITE, libraries)
                path = os.pathsep.join((str(libraries), str(CHECKOUT)))
                short, long = (
                    count(
                        machine, root, path, plugin,
                        ["-P", "-m", "bench.rigs.core_frames", calibration, str(frames)],
                    )
                    for frames in (SHORT, LONG)
                )  # fmt: skip
                found[machine] = (long - short) / (LONG - SHORT)
    except RootBuildError as error:
        print(f"machine_instructions: {error}", file=sys.stderr)
        return 2
    print(json.dumps(found))
    return 0


if __name__ == "__main__":
    sys.exit(main())
