"""Fixtures every room's tests may use, and the watch over what a test leaves behind."""

from __future__ import annotations

import asyncio
import gc
import inspect
import os
import shutil
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

from tests.broker_fixture import IotcoreBroker, MosquittoBroker

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

settings.register_profile("home", deadline=None)  # a loaded machine is no fault of the code
settings.register_profile("ci", deadline=None, derandomize=True)
settings.load_profile("ci" if os.environ.get("CI") else "home")

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the unit has it: read when numpy loads

GRACE_S = 1.0
"""How long a descriptor may take to close: executors and child processes end a little later."""


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real recordings, which lies beside the project and not in it."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not here: {folder}")
    return folder


@pytest.fixture
def mosquitto(tmp_path: Path) -> Iterator[MosquittoBroker]:
    """Yield a running mosquitto on a free loopback port, without persistence."""
    if shutil.which("mosquitto", path=MosquittoBroker.PATH) is None:
        pytest.skip("mosquitto is not installed (Debian: apt install mosquitto)")
    broker = MosquittoBroker(tmp_path)
    broker.start()
    yield broker
    broker.stop()


@pytest.fixture
def iotcore_broker(tmp_path: Path) -> Iterator[IotcoreBroker]:
    """Yield a running iotcore broker: MQTT 3.1.1 at ``port``, MQTT 5 at ``port5``."""
    pytest.importorskip("iotcore", reason="iotcore is not installed (pip install jointfitd[demo])")
    broker = IotcoreBroker(tmp_path)
    broker.start()
    yield broker
    broker.stop()


def _open_descriptors() -> set[tuple[str, str]]:
    found = set()
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names wanted, not paths
        try:
            found.add((name, os.readlink(f"/proc/self/fd/{name}")))  # noqa: PTH115 - need not exist
        except OSError:  # the descriptor of this very listing
            continue
    return found


@pytest.fixture(autouse=True)
def no_descriptor_outlives_its_test() -> Iterator[None]:
    """Fail a test that leaves a file, socket or port open."""
    before = _open_descriptors()
    yield
    if not _open_descriptors() - before:
        return
    gc.collect()
    until = time.monotonic() + GRACE_S
    while (left := _open_descriptors() - before) and time.monotonic() < until:
        time.sleep(0.02)
    if left:
        pytest.fail(f"descriptors left open: {sorted(left)}")


@pytest.fixture
async def tasks_at_the_end() -> AsyncIterator[None]:
    """Fail a test that leaves a task running on its loop."""
    yield
    await asyncio.sleep(0)
    left = asyncio.all_tasks() - {asyncio.current_task()}
    if left:
        pytest.fail(f"tasks left running: {sorted(task.get_name() for task in left)}")


@pytest.fixture(autouse=True)
def no_task_outlives_its_test(
    request: pytest.FixtureRequest, no_descriptor_outlives_its_test: None
) -> None:
    """Watch the tasks of asynchronous tests; others get no event loop for it."""
    function = getattr(request.node, "obj", None)
    if function is not None and inspect.iscoroutinefunction(function):
        request.getfixturevalue("tasks_at_the_end")
