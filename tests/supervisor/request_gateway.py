"""A daemon in this process, its answers to requests, and the state that a request can change."""

from __future__ import annotations

import asyncio
import contextlib
import json
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import orjson
import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.outputs.mqtt import Incoming
from jointfit_daemon.pipeline import Core
from jointfit_daemon.pipeline.events import Notice, Reply
from jointfit_daemon.supervisor import _calibration_store
from jointfit_daemon.supervisor.daemon import Daemon
from tests.broker_fixture import free_port
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Output

BASE = "jointfit/bench-1"


def _toml(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(each)}" for key, each in value.items()) + "}"
    return json.dumps(value)


class Running:
    """A daemon in this process without a broker, with its replies and notices."""

    def __init__(self, folder: Path, rig: dict[str, Any]) -> None:
        self.folder, self.table = folder, rig
        self.write(rig)
        self.daemon: Daemon
        self.replies: list[Reply] = []
        self.notices: list[Notice] = []
        self.topics: list[str] = []

    def write(self, rig: dict[str, Any]) -> None:
        """Write rig.toml."""
        text = []
        for name, part in rig.items():
            for section in part if isinstance(part, list) else [part]:
                text.append(f"[[{name}]]" if isinstance(part, list) else f"[{name}]")
                text += [f"{key} = {_toml(value)}" for key, value in section.items()]
        (self.folder / "rig.toml").write_text("\n".join(text), encoding="utf-8")

    @contextlib.asynccontextmanager
    async def run(self) -> AsyncIterator[Running]:
        """Run the daemon for the duration of the ``async with`` block."""
        self.daemon = Daemon(self.folder / "rig.toml", parse_rig(self.table), Core())
        self.daemon._core.subscribe(self)
        outgoing = self.daemon._outbox.respond

        def respond(topic: str, payload: bytes, **more: Any) -> None:
            found = orjson.loads(payload)
            self.topics.append(topic)
            answer = {key: found[key] for key in ("transaction", "status", "data", "error")}
            self.replies.append(Reply(topic.rpartition("/")[2], **answer))
            outgoing(topic, payload, **more)

        self.daemon._outbox.respond = respond  # type: ignore[method-assign]
        task = asyncio.create_task(self.daemon.run(), name="daemon")
        try:
            await self.until(lambda: hasattr(self.daemon, "_requests"))
            yield self
        finally:
            task.cancel()
            await asyncio.wait([task], timeout=10)
            asyncio.get_running_loop().set_exception_handler(None)
        assert task.cancelled()

    def event(self, event: Any) -> None:
        """Ignore the inputs of the core."""

    def output(self, output: Output) -> None:
        """Collect the notices of the core."""
        if isinstance(output, Notice):
            self.notices.append(output)

    async def until(self, condition: Callable[[], object]) -> None:
        """Wait for a condition."""
        async with asyncio.timeout(10):
            while not condition():
                await asyncio.sleep(0.005)

    async def ask(self, name: str, payload: dict[str, Any] | bytes) -> Reply:
        """Send a request and return its answer."""
        count = len(self.replies)
        data = payload if isinstance(payload, bytes) else orjson.dumps(payload)
        message = Incoming(f"{BASE}/bridge/request/{name}", data, retained=False)
        self.daemon._receive_request(message)
        await self.until(lambda: len(self.replies) > count)
        return self.replies[count]

    def state(self) -> tuple[object, ...]:
        """Return the state that a request can change."""
        core = cast("Any", self.daemon._core.core)
        stored = _calibration_store.store_of(self.daemon.rig).versions()
        session = core._session
        return (
            self.daemon.rig, session.phase, session.calibration, session.version, core._marks,
            stored, len(self.notices),
        )  # fmt: skip


@pytest.fixture(name="gateway")
def gateway_fixture(
    table: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Running:
    """Return a daemon of two sensors with two stored calibrations, which is not started yet."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    rig = {
        "rig": table["rig"],
        "chain": table["chain"],
        "imu": [table["imu"][0], table["imu"][1] | {"segment": "shank"}],
        "mqtt": {"host": "127.0.0.1", "port": free_port()},
    }
    parsed = parse_rig(rig)
    for method in ("mean", "markley"):
        found = replace(plain_calibration(parsed.chain), method=method)
        _calibration_store.save(parsed, replace(found, created_utc=""))
    return Running(tmp_path, rig)
