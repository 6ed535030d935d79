"""The spool stores the messages that an outage would lose, and delivers each once, in order."""

from __future__ import annotations

import asyncio
import contextlib
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.outputs.mqtt import Outbox
from jointfit_daemon.outputs.spool import Spool, SpoolFiles, _spool

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path


@dataclass
class FakeLink:
    """A connection, and the messages that its broker accepted."""

    connected: bool = False
    connects: int = 1
    base: str = "base"
    outbox: Outbox = field(default_factory=lambda: Outbox("base/bridge/state"))
    accepted: list[bytes] = field(default_factory=list)

    async def serve(self) -> None:
        """Accept messages while connected."""
        while True:
            message, acknowledge = await self.outbox.next()
            while not self.connected:
                await asyncio.sleep(0.001)
            assert message.topic == "base/late/event"
            self.accepted.append(message.payload)
            acknowledge()


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the intervals of writing and polling."""
    for name, seconds in (("WRITE_S", 0.01), ("_POLL_S", 0.002), ("START_S", 0.05)):
        monkeypatch.setattr(_spool, name, seconds)
    monkeypatch.setattr(_spool, "SUBSCRIBE_S", 0.02)


@contextlib.asynccontextmanager
async def running(folder: Path, link: FakeLink) -> AsyncIterator[Spool]:
    spool = Spool(SpoolFiles(folder, 1_000_000), lambda: link)
    tasks = [asyncio.create_task(spool.run()), asyncio.create_task(link.serve())]
    try:
        yield spool
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)


def numbers(first: int, end: int) -> list[bytes]:
    return [b'{"t_us":%d}' % number for number in range(first, end)]


def add(spool: Spool, payloads: list[bytes]) -> None:
    for payload in payloads:
        spool.add("late/event", payload)


async def until(condition: Callable[[], object]) -> None:
    async with asyncio.timeout(20):
        while not condition():
            await asyncio.sleep(0.002)


async def test_messages_of_an_outage_are_delivered_after_a_restart(tmp_path: Path) -> None:
    link = FakeLink()
    async with running(tmp_path, link) as spool:
        await asyncio.sleep(0.1)
        add(spool, numbers(0, 50))
        await until(lambda: spool.health().stored_bytes)
        add(spool, numbers(50, 60))  # the daemon writes these messages when it ends
    assert link.accepted == []

    link = FakeLink()
    async with running(tmp_path, link) as spool:
        await until(lambda: spool.health().waiting == 60)
        link.connected = True
        await until(lambda: spool.health().waiting == 0)
    assert link.accepted == numbers(0, 60)
    health = spool.health()
    assert (health.delivered, health.dropped, health.damaged, health.failure) == (60, 0, 0, None)
    assert not os.listdir(tmp_path)  # noqa: PTH208 - in a coroutine


async def test_without_an_outage_nothing_is_stored_or_sent(tmp_path: Path) -> None:
    link = FakeLink(connected=True)
    async with running(tmp_path / "spool", link) as spool:
        add(spool, numbers(0, 50))
        await asyncio.sleep(0.1)
    assert link.accepted == []
    assert not (tmp_path / "spool").exists()


async def test_messages_before_the_connection_of_a_start_are_no_outage(tmp_path: Path) -> None:
    link = FakeLink()
    async with running(tmp_path, link) as spool:
        add(spool, numbers(0, 5))
        link.connected = True
        await asyncio.sleep(0.1)
        assert spool.health().waiting == 0
    assert link.accepted == []


async def test_what_was_sent_before_a_loss_was_noticed_is_stored(tmp_path: Path) -> None:
    link = FakeLink(connected=True)
    async with running(tmp_path, link) as spool:
        await asyncio.sleep(0.05)
        add(spool, numbers(0, 3))
        link.connected = False
        await until(lambda: spool.health().stored_bytes)
        add(spool, numbers(3, 6))
        link.connected = True
        await until(lambda: spool.health().delivered == 6)
    assert link.accepted == numbers(0, 6)


async def test_a_second_outage_during_the_delivery_loses_and_repeats_nothing(
    tmp_path: Path,
) -> None:
    link = FakeLink()
    async with running(tmp_path, link) as spool:
        await asyncio.sleep(0.1)
        add(spool, numbers(0, 200))
        await until(lambda: spool.health().stored_bytes)
        link.connected = True
        await until(lambda: len(link.accepted) > 20)
        link.connected = False
        add(spool, numbers(200, 210))
        await asyncio.sleep(0.05)
        link.connected = True
        await until(lambda: spool.health().waiting == 0)
    assert link.accepted == numbers(0, 210)


async def test_a_disk_that_takes_nothing_is_reported_and_the_oldest_are_counted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_spool, "MOST_PENDING", 100)
    (tmp_path / "file").write_text("")
    link = FakeLink()
    async with running(tmp_path / "file" / "spool", link) as spool:
        await asyncio.sleep(0.1)
        add(spool, numbers(0, 130))
        await until(lambda: spool.health().failure)
        health = spool.health()
        assert (health.waiting, health.dropped) == (100, 30)
        assert "Not a directory" in str(health.failure)
