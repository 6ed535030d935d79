"""What a start and a fit load and use: no more than they need."""

from __future__ import annotations

import asyncio
import subprocess
import sys
from typing import TYPE_CHECKING, Any

from jointfit_daemon.pipeline.events import FitJob
from jointfit_daemon.supervisor.fits import FitRunner

if TYPE_CHECKING:
    import pytest


def test_a_running_daemon_does_without_scipy() -> None:
    code = "import sys, jointfit_daemon.supervisor.daemon; print('scipy' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ran.stdout.strip() == "False"


async def test_a_fit_computes_in_one_thread_unless_told_otherwise(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    given: list[dict[str, str]] = []
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
            FitRunner(tasks, lambda _: None).start(FitJob(1, "no such kind", {}))
    assert [env["OPENBLAS_NUM_THREADS"] for env in given] == ["1", "2"]
