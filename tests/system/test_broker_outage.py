"""Events and poses of a broker outage are published after it, even if the daemon was restarted."""

from __future__ import annotations

import asyncio
import itertools
import signal
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.outputs.mqtt import MqttClient
from jointfit_daemon.tools.child_processes import daemon
from tests.fake_drivers import SMALLEST_RIG, install
from tests.system.station import PATIENCE_S, listening
from tests.system.station import broker as settings

if TYPE_CHECKING:
    from pathlib import Path

    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system
BASE = "jointfit/bench"
POSE_HZ = 5.0


async def test_messages_of_an_outage_survive_a_kill_of_the_daemon(
    tmp_path: Path, broker: Broker, monkeypatch: pytest.MonkeyPatch
) -> None:
    install(tmp_path / "drivers")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "drivers"), prepend=":")
    rig = tmp_path / "rig.toml"
    text = SMALLEST_RIG.format(port=broker.port) + f"[mqtt.spool]\npose_hz = {POSE_HZ}\n"
    rig.write_text(text, encoding="utf-8")
    async with listening(broker.port, BASE) as listener, daemon(tmp_path, rig) as child:
        await listener.more_poses()
        broker.stop()
        await asyncio.sleep(2.0)
        assert child.process is not None
        child.process.send_signal(signal.SIGKILL)
        await child.process.wait()

    async with daemon(tmp_path, rig):
        spool = tmp_path / "state" / "spool" / "bench"
        async with asyncio.timeout(PATIENCE_S):
            while not any(path.name > "00000001.spool" for path in spool.iterdir()):
                await asyncio.sleep(0.05)
        broker.start()
        events, t_us = [], []
        async with (
            asyncio.timeout(PATIENCE_S),
            MqttClient(settings(broker.port, BASE)) as client,
        ):
            await client.subscribe("late/event", "late/pose")
            async for topic, payload in client.messages():
                if topic == "late/event":
                    events.append(payload)
                else:
                    t_us.append(payload["t_us"])
                started = [event for event in events if event["text"] == "streaming"]
                if started and t_us and len(t_us) > 2 * POSE_HZ and t_us[-1] > started[-1]["t_us"]:
                    break
    assert t_us == sorted(t_us)
    steps = [(after - before) / 1e6 for before, after in itertools.pairwise(t_us)]
    assert sorted(steps)[len(steps) // 2] == pytest.approx(1 / POSE_HZ, rel=0.2)
