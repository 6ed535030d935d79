"""Workers forked after one collection: ``pytest -p tests.forked_workers --workers 6``.

A worker of pytest-xdist imports and collects thousands of tests itself. Here, one process collects
the tests, and its forks share modules and tests. A fork requests one batch at a time. Tests that
share fixtures of a module are in one batch, so the fixtures are set up once.

Invariant: every test is reported once. If a worker dies during a test, this test fails, and the
following tests run in a new worker. If a test ignores its time limit, its worker is killed.
"""

from __future__ import annotations

import itertools
import os
import sys
import time
from collections import deque
from dataclasses import dataclass, field
from multiprocessing import connection, get_context
from types import SimpleNamespace
from typing import TYPE_CHECKING, TypeAlias

import pytest
from _pytest.config import create_terminal_writer

if TYPE_CHECKING:
    from multiprocessing.context import ForkProcess
    from pathlib import Path

Batch: TypeAlias = list[int]
"""Indices of tests in the order of the collection."""

LARGEST = 20
"""Maximum number of tests in a batch of tests without shared fixtures."""
CHECK_S = 1.0
"""Longest interval between two checks for tests that ignore their time limit, s."""
WORKERS_THAT_WAIT = 2
"""Number of workers that begin with real-time tests, which wait for half of their time."""
FIT_NICE = 10
"""Nice value of a worker whose tests compute. It equals the nice value of a fit of the daemon.

Therefore daemons and devices in real time have a higher priority than these tests, and a fit of a
daemon has the same priority. A process cannot raise its priority again, so another worker starts
after the last of these tests.
"""


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the option for the number of workers."""
    parser.addoption("--workers", type=int, metavar="N", help="run the tests in N forked workers")
    text = "kill the worker of a test that runs S seconds longer than its time limit"
    parser.addoption("--kill-after", type=float, metavar="S", default=60.0, help=text)


def pytest_configure(config: pytest.Config) -> None:
    """Print no paths, because the tests of all workers are reported as they end."""
    if config.getoption("workers") and not config.option.verbose:
        config.option.verbose = -1


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop(session: pytest.Session) -> bool | None:
    """Run the collected tests in workers; return None if pytest itself must run them."""
    workers: int | None = session.config.getoption("workers")
    if not workers or not session.items or session.testsfailed or session.config.option.collectonly:
        return None
    _Workers(session).run(workers)
    if session.shouldfail:
        raise session.Failed(session.shouldfail)
    if session.shouldstop:
        raise session.Interrupted(session.shouldstop)
    return True


def waits(item: pytest.Item) -> bool:
    """Return whether a test waits for devices or daemons in real time."""
    return _marked(item, "system", "real_time")


def _marked(item: pytest.Item, *names: str) -> bool:
    return any(item.get_closest_marker(name) is not None for name in names)


def limit_s(item: pytest.Item) -> float:
    """Return the time limit of a test, s; long tests have long limits."""
    marker = item.get_closest_marker("timeout")
    return float(marker.args[0] if marker else item.config.getini("timeout"))


def batches(items: list[pytest.Item], *, waiting: bool) -> deque[Batch]:
    """Return the waiting tests or all others in batches, those with long limits first.

    Tests of a file that share fixtures are in one batch. Other tests are divided. An experiment, or
    a test with its own time limit, is long and therefore a batch of its own.
    """
    chosen = [index for index, item in enumerate(items) if waits(item) is waiting]
    found: list[Batch] = []
    for _, indices in itertools.groupby(chosen, key=lambda index: items[index].path):
        of_file = list(indices)
        if any(_shares_fixtures(items[index]) for index in of_file):
            found.append(of_file)
            continue
        long = [index for index in of_file if _marked(items[index], "timeout", "experiment")]
        short = [index for index in of_file if index not in long]
        found += [[index] for index in long]
        found += [short[begin : begin + LARGEST] for begin in range(0, len(short), LARGEST)]
    return deque(sorted(found, key=lambda batch: -max(limit_s(items[index]) for index in batch)))


def _shares_fixtures(item: pytest.Item) -> bool:
    fixtures: dict[str, list[pytest.FixtureDef[object]]]
    fixtures = item._fixtureinfo.name2fixturedefs  # type: ignore[attr-defined]  # no public way
    scopes = {definitions[-1].scope for definitions in fixtures.values()}
    return not scopes.isdisjoint({"class", "module", "package"})


@dataclass
class _Worker:
    process: ForkProcess
    channel: connection.Connection
    waiting: bool
    """Whether the worker runs the waiting tests first and then the others, instead of the others
    only."""
    left: Batch = field(default_factory=list)
    """Tests that the worker has received and not finished. The first one is running."""
    began_s: float = 0.0
    """Monotonic time at which the first test in `left` started, s."""


class _Workers:
    """The worker processes, and the tests that no worker has received."""

    def __init__(self, session: pytest.Session) -> None:
        self._session = session
        self._config = session.config
        self._queues = {kind: batches(session.items, waiting=kind) for kind in (True, False)}
        self._workers: dict[connection.Connection, _Worker] = {}
        self._started = 0
        self._folder = session.config._tmp_path_factory.getbasetemp()  # type: ignore[attr-defined]  # as xdist

    def run(self, number: int) -> None:
        """Run all tests in this number of workers."""
        for _ in range(number):
            self._start(waiting=number == 1 or self._started < WORKERS_THAT_WAIT)
        try:
            while self._workers:
                for channel in connection.wait(list(self._workers), timeout=CHECK_S):
                    self._serve(self._workers[channel])  # type: ignore[index]  # one of ours
                self._kill_those_that_hang()
        finally:
            for worker in self._workers.values():
                worker.process.terminate()
                worker.process.join()

    def _start(self, *, waiting: bool) -> None:
        ours, theirs = get_context("fork").Pipe()
        folder = self._folder / f"worker-{self._started}"
        process = get_context("fork").Process(
            target=_work,
            args=(self._session, theirs, folder, not waiting, [*self._workers, ours]),
        )
        sys.stdout.flush()
        sys.stderr.flush()
        process.start()
        theirs.close()
        self._workers[ours] = _Worker(process, ours, waiting)
        self._started += 1

    def _serve(self, worker: _Worker) -> None:
        """Process one message of a worker; replace a worker that has died."""
        try:
            kind, content = worker.channel.recv()
        except (EOFError, ConnectionResetError):
            kind, content = "ended", None
        if kind == "ended":
            self._close(worker)
        elif kind == "next":
            batch = self._take(worker)
            if not worker.left:
                worker.began_s = time.monotonic()
            worker.left.extend(batch)
            worker.channel.send(batch)
        elif kind == "finished":
            worker.left.remove(content)
            worker.began_s = time.monotonic()
        else:
            report = self._config.hook.pytest_report_from_serializable(
                config=self._config, data=content
            )
            self._config.hook.pytest_runtest_logreport(report=report)

    def _kill_those_that_hang(self) -> None:
        """Kill workers whose test ignored its limit; asyncio suppresses exceptions in callbacks."""
        grace_s: float = self._config.getoption("--kill-after")
        for worker in self._workers.values():
            if worker.left:
                allowed_s = limit_s(self._session.items[worker.left[0]]) + grace_s
                if time.monotonic() - worker.began_s > allowed_s:
                    worker.process.kill()

    def _take(self, worker: _Worker) -> Batch:
        if self._session.shouldfail or self._session.shouldstop:
            return []
        for kind in (True, False) if worker.waiting else (False,):
            while self._queues[kind]:
                if batch := self._queues[kind].popleft():
                    return batch
        return []

    def _close(self, worker: _Worker) -> None:
        del self._workers[worker.channel]
        worker.channel.close()
        worker.process.join()
        if worker.left:
            self._report_death(worker)
            self._queues[worker.waiting].appendleft(worker.left[1:])
            self._start(waiting=worker.waiting)
        elif not worker.waiting and any(self._queues.values()):
            self._start(waiting=True)

    def _report_death(self, worker: _Worker) -> None:
        item = self._session.items[worker.left[0]]
        text = f"worker died in {item.nodeid}, exit status {worker.process.exitcode}"
        report = pytest.TestReport(
            item.nodeid, item.location, {}, outcome="failed", longrepr=text, when="call"
        )
        self._config.hook.pytest_runtest_logreport(report=report)


def _work(
    session: pytest.Session,
    channel: connection.Connection,
    folder: Path,
    nice: bool,
    inherited: list[connection.Connection],
) -> None:
    """Run batches until none remains; this is the main function of a worker."""
    for other in inherited:  # copies would hide the end of the first process
        other.close()
    if nice:
        os.nice(FIT_NICE)
    _become_worker(session.config, channel, folder)

    def take() -> Batch:
        channel.send(("next", None))
        batch: Batch = channel.recv()
        return batch

    # Fixtures that the next test also needs remain, so the next test must be known before a test
    # ends.
    indices = itertools.chain.from_iterable(iter(take, []))
    index = next(indices, None)
    while index is not None:
        following = next(indices, None)
        item = session.items[index]
        successor = None if following is None else session.items[following]
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=successor)
        channel.send(("finished", index))
        index = following
    channel.close()


def _become_worker(config: pytest.Config, channel: connection.Connection, folder: Path) -> None:
    """Send reports to the first process, and use a separate folder for the worker."""
    plugins = config.pluginmanager
    for hook in config.hook.pytest_runtest_logreport.get_hookimpls():
        if hook.plugin_name not in {"session", "logging-plugin"}:
            plugins.unregister(hook.plugin)
    # pytest-timeout writes the stacks of threads that hang to the terminal.
    terminal = SimpleNamespace(_tw=create_terminal_writer(config, sys.stderr))
    plugins.register(terminal, "terminalreporter")
    plugins.register(_Reporter(config, channel))

    factory = config._tmp_path_factory  # type: ignore[attr-defined]  # as xdist
    factory._given_basetemp, factory._basetemp = folder, None


class _Reporter:
    """Plugin that sends the reports of a worker."""

    def __init__(self, config: pytest.Config, channel: connection.Connection) -> None:
        self._config = config
        self._channel = channel

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        data = self._config.hook.pytest_report_to_serializable(config=self._config, report=report)
        self._channel.send(("report", data))
