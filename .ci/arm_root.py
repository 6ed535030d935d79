"""Run the tests without time limits on the installed arm64 package: `make test-arm`.

    .ci/arm_root.py [--arch ARCH] [--suite NAME] [--package PACKAGE] [--recording PATH] [TESTS ...]

The package is installed in a Debian arm64 system. QEMU's user emulation runs this system, ten to
twenty times slower than this machine. The tests import the installed package, with Debian's numpy
and scipy, and not the modules of the checkout. A recording that was made on this machine is
replayed in the arm64 system and compared with the results of this machine. Its calibration is
fitted again there. With ``--arch amd64`` the same steps run without emulation, which separates
effects of the processor from those of Debian's libraries.

The JUnit reports and the fitted calibration are written to ``build/ARCH``. The exit status is 1 if
something failed, or 2 if the system cannot be set up.
"""

from __future__ import annotations

import argparse
import json
import platform
import shlex
import shutil
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any

from deb_root import tools_for, with_package
from debian_root import CACHE, SUITE, RootBuildError, require, run
from packaging.requirements import Requirement

CHECKOUT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(CHECKOUT / "packaging"))

from deb import PLATFORMS  # noqa: E402 - from the folder above

if TYPE_CHECKING:
    from collections.abc import Iterator

PYTHONS = {"bookworm": "3.11", "trixie": "3.13"}
"""Python version of each release of Debian."""
GLIBC = "manylinux_2_34"
"""Platform tag with the newest glibc (2.34) that the wheels of the test libraries may need. Debian
12 has glibc 2.36."""
MACHINES = {"amd64": "x86_64", "arm64": "aarch64"}
TESTS = [
    f"tests/{name}"
    for name in (
        "protocols", "config", "timing", "files", "kinematics", "limb_model", "center_of_rotation",
        "fusion", "reprocessing", "drivers", "calibration",
    )
]  # fmt: skip
"""Tests of the packages that compute, in order of their duration."""
FAST = "not system and not experiment and not alone and not real_time and not vm"
"""Marker expression for the tests without time limits and without other processes."""
NOT_IN_EMULATION = (
    "tests/drivers/natnet/test_natnet_diagnosis.py",
    "tests/drivers/natnet/test_natnet_session.py",
    "tests/drivers/natnet/test_natnet_hostile.py::test_a_model_of_one_datagram",
    "tests/drivers/ports/test_python_can_bus.py::test_link_down_is_reported_once",
    "tests/calibration/phases/test_functional_fit.py::test_correction_has_smaller_errors",
)
"""Beginnings of the names of tests that fail in QEMU's user emulation. Some need the socket options
IP_MULTICAST_IF or SO_MEMINFO, or error reports of CAN, which the emulation lacks. Others limit the
processor time."""
PACKAGED = ("jointfit_daemon", "drivers", "protocols", "simulators", "jointfit_variant.py")
"""Paths of the checkout that the tests must import from the package."""
FIT_TOLERANCE = 1e-9
"""Largest accepted difference between the calibrations fitted in the system and on this machine. It
is relative for numbers above 1, and absolute for smaller numbers. The libraries of the system and
of this machine round differently."""
RECORD = """\
import pathlib, sys
from tests.reprocessing.recorded_run import record_run
record_run(pathlib.Path(sys.argv[1]))
"""
STEPS = """\
mkdir -p "$root/usr/local/lib/jointfitd" "$root/checkout"
cp -r {work}/libraries/. "$root/usr/local/lib/jointfitd"
tar -xf {work}/checkout.tar -C "$root/checkout"
cp -r {work}/recording "$root/checkout/recording"
chown -R 1000:1000 "$root/checkout"
failed=0
step() {{
  echo "== $1"
  inside "cd /checkout && export HYPOTHESIS_PROFILE=few && $1" || failed=1
  cp "$root"/checkout/*.xml "$root"/checkout/*.json {out}/ 2>/dev/null || true
  chown --reference={out} {out}/* 2>/dev/null || true
}}
step 'jointfitd --version'
step 'jointfit doctor'
step 'jointfit replay recording --verify'
step 'jointfit calibrate --recording recording --out fitted.json'
"""
"""Shell commands before the tests. The libraries of the tests are installed in the folder for
separate driver packages, /usr/local/lib/jointfitd. The jointfitd package searches this folder after
its own libraries."""
PYTEST = (
    "/usr/lib/jointfitd/bin/python3 -m pytest -q -p no:cacheprovider -p tests.older_scipy"
    " -o timeout=0 -o pythonpath=."
)


def main() -> int:
    """Set up the system, and run the steps in it; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--arch", choices=MACHINES, default="arm64")
    parser.add_argument("--suite", choices=PYTHONS, default=SUITE, help="release of Debian")
    parser.add_argument("--package", type=Path, help="default: built from the last commit")
    parser.add_argument("--recording", type=Path, help="default: a simulated run of five seconds")
    parser.add_argument("tests", nargs="*", default=TESTS)
    given = parser.parse_args()
    out = CHECKOUT / "build" / given.arch
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)

    try:
        require(tools_for(given.arch))
    except RootBuildError as error:
        print(f"arm_root: {error}", file=sys.stderr)
        return 2
    CACHE.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(prefix="arm-run-", dir=CACHE))
    try:
        package = given.package or _build(given.arch, work)
        _prepare(work, given.arch, given.suite, given.recording)
        steps = STEPS.format(work=shlex.quote(str(work)), out=shlex.quote(str(out)))
        for test in given.tests:
            report = test.replace("/", "-") + ".xml"
            command = f'{PYTEST} -m "{FAST}" --junitxml={report} {test}'
            if MACHINES[given.arch] != platform.machine():
                command += "".join(f" --deselect {name}" for name in NOT_IN_EMULATION)
            steps += f"step {shlex.quote(command)}\n"
        status = with_package(package, given.suite, f"{steps}exit $failed\n")
        is_same = _is_same_fit(out / "fitted.json", work)  # also after a failed step
        return int(status != 0 or not is_same)
    except RootBuildError as error:
        print(f"arm_root: {error}", file=sys.stderr)
        return 2
    finally:
        shutil.rmtree(work)


def _is_same_fit(fitted: Path, work: Path) -> bool:
    """Compare the fitted calibration with a fit on this machine; return whether they agree.

    The largest difference is printed.
    """
    if not fitted.is_file():
        return False  # the step that failed has reported it
    here = work / "here.json"
    program = [sys.executable, "-m", "jointfit_daemon.tools"]
    recording = str(work / "recording")
    run([*program, "calibrate", "--recording", recording, "--out", str(here)], CHECKOUT)
    theirs, ours = (
        list(_numbers(json.loads(path.read_text(encoding="utf-8"))["calibration"]))
        for path in (fitted, here)
    )
    largest = max(abs(a - b) / max(1.0, abs(b)) for a, b in zip(theirs, ours, strict=True))
    print(f"fitted calibration: {len(ours)} numbers differ from this machine by at most {largest}")
    return largest <= FIT_TOLERANCE


def _numbers(value: Any) -> Iterator[float]:
    """Yield the numbers in a JSON value."""
    if isinstance(value, dict | list):
        for each in value.values() if isinstance(value, dict) else value:
            yield from _numbers(each)
    elif isinstance(value, int | float):
        yield value


def _build(architecture: str, work: Path) -> Path:
    run([sys.executable, "packaging/deb.py", "--arch", architecture, "--out", str(work)], CHECKOUT)
    (package,) = work.glob("*.deb")
    return package


def _prepare(work: Path, architecture: str, suite: str, recording: Path | None) -> None:
    """Write the libraries of the tests, the checkout without the package, and the recording."""
    install(_libraries(architecture, suite), architecture, suite, work / "libraries")
    excluded = [f":(exclude){path}" for path in PACKAGED]
    tar = str(work / "checkout.tar")
    run(["git", "archive", f"--output={tar}", "HEAD", "--", ".", *excluded], CHECKOUT)
    if recording is None:
        run([sys.executable, "-c", RECORD, str(work / "recording")], CHECKOUT)
    else:
        shutil.copytree(recording, work / "recording")


def install(requirements: list[str], architecture: str, suite: str, target: Path) -> None:
    """Install wheels into a folder, for an architecture and the Python of a Debian release."""
    names = (*PLATFORMS[architecture], f"{GLIBC}_{MACHINES[architecture]}")
    platforms = (word for name in names for word in ("--platform", name))
    run(
        [
            sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check",
            "--target", str(target), "--only-binary=:all:", "--no-compile",
            "--implementation", "cp", "--python-version", PYTHONS[suite], *platforms,
            "--constraint", "requirements.lock", *requirements,
        ],
        CHECKOUT,
    )  # fmt: skip


def _libraries(architecture: str, suite: str) -> list[str]:
    """Return the test requirements for an architecture; pip would use this machine's markers."""
    project = tomllib.loads((CHECKOUT / "pyproject.toml").read_text(encoding="utf-8"))
    machine = {"platform_machine": MACHINES[architecture], "python_version": PYTHONS[suite]}
    needed = map(Requirement, project["dependency-groups"]["test"])
    return [
        f"{each.name}{each.specifier}"
        for each in needed
        if each.marker is None or each.marker.evaluate(machine)
    ]


if __name__ == "__main__":
    sys.exit(main())
