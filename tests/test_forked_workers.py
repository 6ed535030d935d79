"""Every test of a run in forked workers is reported once, even where a worker dies."""

from __future__ import annotations

import os
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TESTS = """\
import os
from pathlib import Path
import pytest

HERE = Path(__file__).parent

@pytest.fixture(scope="module")
def once():
    with (HERE / "once.txt").open("a") as file:
        file.write(f"{__name__} set-up\\n")
    yield
    with (HERE / "once.txt").open("a") as file:
        file.write(f"{__name__} torn down\\n")

@pytest.mark.parametrize("number", range(3))
def test_passes(once, number, tmp_path): assert "worker-" in str(tmp_path)

def test_fails(once): assert 1 == 2

@pytest.mark.skip
def test_is_skipped(): ...
"""
DEATH = """
def test_kills_its_worker(): os._exit(3)

def test_behind_the_killed_one(subtests):
    with subtests.test("part"): assert 3 == 4
"""


def test_every_test_is_reported_once_and_a_death_of_a_worker_fails_one(tmp_path: Path) -> None:
    for name, content in {"one": TESTS, "two": TESTS, "killed": TESTS + DEATH}.items():
        folder = tmp_path / name
        folder.mkdir()
        (folder / f"test_{name}.py").write_text(content)
    options = ["-c", "pyproject.toml", f"--rootdir={tmp_path}", "--workers=2"]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "tests.forked_workers", *options,
         f"--junitxml={tmp_path}/report.xml", str(tmp_path)],
        cwd=ROOT, check=False, capture_output=True, text=True,
    )  # fmt: skip

    summary = run.stdout.splitlines()[-1]
    assert run.returncode == 1
    assert summary.startswith("5 failed, 10 passed, 3 skipped"), run.stdout
    assert (
        "worker died in killed/test_killed.py::test_kills_its_worker, exit status 3" in run.stdout
    )
    cases = list(ET.parse(tmp_path / "report.xml").getroot().iter("testcase"))
    names = [f"{case.get('classname')}::{case.get('name')}" for case in cases]
    assert len(names) == len(set(names)) == 17

    # A file stays in one worker, so that fixtures of modules are set up once.
    for name in ("one", "two"):
        lines = (tmp_path / name / "once.txt").read_text().splitlines()
        assert [line.partition(" ")[2] for line in lines] == ["set-up", "torn down"]


HANG = """\
import signal, time
import pytest

@pytest.mark.timeout(1)
def test_ignores_its_time_limit():
    signal.setitimer(signal.ITIMER_REAL, 0)
    time.sleep(80)

def test_behind_the_one_that_hangs(): ...
"""


def test_a_test_that_ignores_its_time_limit_fails_and_the_others_run(tmp_path: Path) -> None:
    (tmp_path / "test_hang.py").write_text(HANG)
    options = ["-c", "pyproject.toml", f"--rootdir={tmp_path}", "--workers=1", "--kill-after=1"]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "tests.forked_workers", *options, str(tmp_path)],
        cwd=ROOT, check=False, capture_output=True, text=True, timeout=60,
    )  # fmt: skip

    assert "worker died in test_hang.py::test_ignores_its_time_limit" in run.stdout
    assert run.stdout.splitlines()[-1].startswith("1 failed, 1 passed"), run.stdout


PRIORITIES = """\
import os, time
import pytest

USUAL = int(os.environ["USUAL"])

@pytest.mark.experiment
@pytest.mark.parametrize("number", range(4))
def test_computes(number):
    assert os.getpriority(os.PRIO_PROCESS, 0) in {USUAL, min(USUAL + 10, 19)}

@pytest.mark.system
@pytest.mark.experiment
@pytest.mark.parametrize("number", range(12))
def test_in_real_time(number):
    time.sleep(0.05)
    assert os.getpriority(os.PRIO_PROCESS, 0) == USUAL
"""


def test_a_test_in_real_time_never_runs_at_the_priority_of_those_that_compute(
    tmp_path: Path,
) -> None:
    (tmp_path / "test_priorities.py").write_text(PRIORITIES)
    options = ["-c", "pyproject.toml", f"--rootdir={tmp_path}", "--workers=4"]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "tests.forked_workers", *options, str(tmp_path)],
        cwd=ROOT, check=False, capture_output=True, text=True,
        env=os.environ | {"USUAL": str(os.getpriority(os.PRIO_PROCESS, 0))},
    )  # fmt: skip
    assert run.stdout.splitlines()[-1].startswith("16 passed"), run.stdout
