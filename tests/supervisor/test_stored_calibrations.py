"""Stored calibrations and the worker process: faults in files are reported."""

from __future__ import annotations

import asyncio
import os
import pickle
import subprocess
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import Rig, parse_rig
from jointfit_daemon.supervisor import _calibration_store
from jointfit_daemon.supervisor._stored_versions import StoredVersions
from jointfit_daemon.supervisor.worker import HEADER
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def rig(table: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rig:
    monkeypatch.setenv("STATE_DIRECTORY", f"{tmp_path / 'state'}:/elsewhere")
    return parse_rig(table | {"calibration": {"store": "subject-07"}})


def test_empty_store_has_no_calibration(rig: Rig) -> None:
    assert _calibration_store.load_latest(rig) == (None, None, ())


def test_saved_calibration_is_loaded_with_version_and_date(rig: Rig) -> None:
    assert _calibration_store.save(rig, plain_calibration(rig.chain)) == 1
    assert _calibration_store.save(rig, plain_calibration(rig.chain)) == 2
    found = _calibration_store.load_latest(rig)
    assert found.version == 2
    assert found.calibration is not None
    assert found.calibration.created_utc.endswith("+00:00")
    assert found.warnings == ()


def test_a_version_with_online_learning_is_listed_with_its_errors(rig: Rig) -> None:
    learned = {"rounds": 2, "from_version": 1, "before_rad": {"knee": 0.1}, "frames": 900,
               "after_rad": {"knee": 0.05}}  # fmt: skip
    for quality in ({}, {"online": learned}):
        plain = plain_calibration(rig.chain)
        _calibration_store.save(rig, replace(plain, quality=quality))
    last, first = StoredVersions().list(rig, 9)["versions"]
    assert first["online"] is None
    assert last["online"] == {
        "rounds": 2, "from_version": 1, "before_deg": {"knee": 5.73}, "after_deg": {"knee": 2.865}
    }  # fmt: skip


def test_a_calibration_of_another_limb_is_not_used(rig: Rig) -> None:
    _calibration_store.save(
        rig, plain_calibration(rig.chain, joints=("shoulder", "elbow", "wrist"))
    )
    found = _calibration_store.load_latest(rig)
    assert found.calibration is None
    assert "belongs to another limb" in found.warnings[0]


def test_damaged_store_is_reported(rig: Rig, tmp_path: Path) -> None:
    _calibration_store.save(rig, plain_calibration(rig.chain))
    _calibration_store.store_of(rig).path(1).write_text("{")
    found = _calibration_store.load_latest(rig)
    assert found.calibration is None
    assert "cannot be used" in found.warnings[0]
    assert "renamed to 0001.json.bad" in found.warnings[0]


async def test_worker_ends_with_its_parent(tmp_path: Path) -> None:
    """The parent process starts a worker with a job of a minute and is then killed."""
    parent = (
        "import subprocess, sys, time\n"
        "worker = subprocess.Popen([sys.executable, '-c', sys.argv[1]], stdin=subprocess.PIPE)\n"
        "worker.stdin.write(sys.stdin.buffer.read()); worker.stdin.flush()\n"
        "print(worker.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    worker = (
        "import time, jointfit_daemon.calibration.phases as phases\n"
        "phases.run_job = lambda job: time.sleep(60)\n"
        "from jointfit_daemon.supervisor.worker import main\n"
        "main()\n"
    )
    job = pickle.dumps("any job")
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-c", parent, worker,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write(HEADER.pack(len(job)) + job)
    process.stdin.close()
    pid = int(await process.stdout.readline())
    await asyncio.sleep(1.0)
    os.kill(pid, 0)  # the worker runs
    process.kill()
    await process.wait()
    async with asyncio.timeout(10):
        while _alive(pid):
            await asyncio.sleep(0.05)


def _alive(pid: int) -> bool:
    try:
        with open(f"/proc/{pid}/stat", encoding="ascii") as stat:  # noqa: PTH123 - /proc
            return stat.read().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
