"""Imported modules and number of threads of the daemon, of commands and of a fit."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from typing import Any

import pytest

from jointfit_daemon.calibration import CalibrationSettings, CalibrationTrial, StaticJob
from jointfit_daemon.model import Chain
from jointfit_daemon.pipeline.events import FitJob
from jointfit_daemon.supervisor._fit_runner import FitRunner


def test_a_running_daemon_does_without_scipy() -> None:
    code = "import sys, jointfit_daemon.supervisor.daemon; print('scipy' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "False"


@pytest.mark.real_time
async def test_fit_uses_one_thread_by_default(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[dict[str, str]] = []
    broken = StaticJob(Chain((), (), ()), CalibrationSettings(), CalibrationTrial({}, None))
    start = asyncio.create_subprocess_exec

    async def watched(*words: str, env: dict[str, str], **more: Any) -> Any:
        given.append(env)
        return await start(*words, env=env, **more)

    monkeypatch.setattr(asyncio, "create_subprocess_exec", watched)
    for told in (None, "2"):
        monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
        if told:
            monkeypatch.setenv("OPENBLAS_NUM_THREADS", told)
        async with asyncio.TaskGroup() as tasks:
            FitRunner(tasks, lambda _: None).start(FitJob(1, broken))
    assert [env["OPENBLAS_NUM_THREADS"] for env in given] == ["1", "2"]


@pytest.mark.parametrize(("asked", "used"), [(None, "1"), ("2", "2")])
def test_command_uses_one_thread_by_default(asked: str | None, used: str) -> None:
    code = """
import atexit, os, sys
from jointfit_daemon.tools.__main__ import main
assert "numpy" not in sys.modules  # it reads the number of threads when imported
atexit.register(lambda: print(os.environ["OPENBLAS_NUM_THREADS"]))
main()
"""
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    if asked is not None:
        environment["OPENBLAS_NUM_THREADS"] = asked
    ran = subprocess.run(
        [sys.executable, "-c", code, "--version"],
        env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert ran.stdout.split()[-1] == used
