"""Fixtures for all tests, and checks that a test leaves no open file, socket or task."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import gc
import inspect
import os
import re
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
import typer.testing
from hypothesis import settings
from typer.main import get_command

from tests.broker_fixture import EmbeddedBroker, MosquittoBroker, chosen_broker
from tests.fake_rig import fakes, table  # noqa: F401 - fixtures
from tests.lsl_fixture import lsl, lsl_network  # noqa: F401 - fixtures

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Generator, Iterator

    from tests.broker_fixture import Broker

# The suite draws the same inputs in every run, so its outcome does not depend on chance. New inputs
# are searched with HYPOTHESIS_PROFILE=search and `make fuzz`. Load may be high, so there is no
# deadline.
settings.register_profile("suite", deadline=None, derandomize=True, max_examples=50)
settings.register_profile("few", deadline=None, derandomize=True, max_examples=10)
settings.register_profile("search", deadline=None, max_examples=500)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "suite"))

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as in the systemd unit
# jsonschema would import this module for two seconds, for the unused format `iri`.
sys.modules.setdefault("rfc3987_syntax", None)  # type: ignore[arg-type]  # None: import fails

# Without the cache, the runner builds all commands in each of a thousand calls, 35 ms each.
typer.testing._get_command = functools.cache(get_command)  # type: ignore[attr-defined]  # private

PARTS = ("parallel", "alone", "experiments", "experiments-alone")
"""Groups of tests that run together, defined by the markers `experiment` and `alone`."""
ONLY_EXPERIMENTS = re.compile(r"^pytestmark = .*\bmark\.experiment\b", re.MULTILINE)
"""Line of a file whose tests are all experiments."""
EXPERIMENT_TIMEOUT_S = 600.0
"""Time limit of an experiment without a limit of its own. It ends experiments that hang.
Experiments that compute run at low priority and may take ten times as long as alone.
"""
GRACE_S = 6.0
"""Time for descriptors and tasks to close after a test, s. Executors, child processes and the
connection check of an MQTT client, which runs once per second, end later than the test.
"""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option with which the Makefile runs the suite in parts."""
    parser.addoption(
        "--part",
        choices=PARTS,
        help="only the tests of this part of the suite",
    )


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep the garbage collector from scanning the million objects of all modules and tests."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Ignore files that contain only experiments if the part of the suite has no experiments."""
    part = config.getoption("part")
    if part not in {"parallel", "alone"} or collection_path.suffix != ".py":
        return None
    text = collection_path.read_text(encoding="utf-8")
    return True if ONLY_EXPERIMENTS.search(text) else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Set the time limit of experiments, and deselect the tests of the other parts."""
    for item in items:
        if item.get_closest_marker("experiment") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(EXPERIMENT_TIMEOUT_S))
    part = config.getoption("part")
    if part is None:
        return
    chosen = [item for item in items if _part_of(item) == part]
    if len(chosen) < len(items):
        config.hook.pytest_deselected(items=[item for item in items if _part_of(item) != part])
        items[:] = chosen


def _part_of(item: pytest.Item) -> str:
    experiment, alone = (
        item.get_closest_marker(name) is not None for name in ("experiment", "alone")
    )
    return PARTS[2 * experiment + alone]


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Return the folder of real recordings, which is not part of the project."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"real recordings are not here: {folder}")
    return folder


@contextlib.contextmanager
def _running(make: Callable[[], Broker], missing: str | None) -> Iterator[Broker]:
    if missing is not None:
        pytest.skip(missing)
    broker = make()
    broker.start()
    try:
        yield broker
    finally:
        broker.stop()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    """Yield a running broker of the class that `chosen_broker` returns, on free loopback ports."""
    chosen = chosen_broker()
    with _running(lambda: chosen(tmp_path), chosen.missing()) as running:
        yield running


@pytest.fixture
def embedded_broker(tmp_path: Path) -> Iterator[Broker]:
    """Yield a running iotcore, the broker that is installed by pip."""
    with _running(lambda: EmbeddedBroker(tmp_path), EmbeddedBroker.missing()) as running:
        yield running


@pytest.fixture
def start_mosquitto(tmp_path: Path) -> Iterator[Callable[[str], Broker]]:
    """Yield a function that starts a mosquitto with additional lines of configuration.

    The embedded broker does not support TLS, passwords and access lists.
    """
    with contextlib.ExitStack() as brokers:

        def start(more: str) -> Broker:
            made = _running(lambda: MosquittoBroker(tmp_path, more=more), MosquittoBroker.missing())
            return brokers.enter_context(made)

        yield start


@pytest.fixture
def mosquitto(start_mosquitto: Callable[[str], Broker]) -> Broker:
    """Return a running mosquitto with the default configuration."""
    return start_mosquitto("")


def _open_descriptors() -> set[tuple[str, str]]:
    found = set()
    for name in os.listdir("/proc/self/fd"):  # noqa: PTH208 - names wanted, not paths
        try:
            found.add((name, os.readlink(f"/proc/self/fd/{name}")))  # noqa: PTH115 - need not exist
        except OSError:  # the descriptor of this listing
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
        _, left = await asyncio.wait(left, timeout=GRACE_S)
    if left:
        pytest.fail(f"tasks left running: {sorted(task.get_name() for task in left)}")


@pytest.fixture(autouse=True)
def no_task_outlives_its_test(
    request: pytest.FixtureRequest, no_descriptor_outlives_its_test: None
) -> None:
    """Fail an asynchronous test that leaves a task running; other tests need no event loop."""
    function = getattr(request.node, "obj", None)
    if function is not None and inspect.iscoroutinefunction(function):
        request.getfixturevalue("tasks_at_the_end")
