"""What a live daemon did can be done again: its event log gives its limb states byte for byte."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.outputs.recording import encode_state, read_events, read_states
from jointfit_daemon.pipeline import replay_states
from jointfit_daemon.pipeline.events import Configured, JobFinished, SourceClosed, SourceOpened
from tests.system.station import SENSORS, Listener, Station, hang_up, running, stopped

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.child_processes import Child, Simulator
    from tests.broker_fixture import Broker

pytestmark = pytest.mark.system

SETTLE_S = 1.7
"""A motion blends into the next for 1.5 s."""


async def calibrated(simulator: Simulator, listener: Listener) -> None:
    for motion, phase, seconds in (
        ("plate", "align", 8.0), ("stand", "static", 3.0), ("functional", "functional", 12.0),
    ):  # fmt: skip
        await simulator.say(f"play {motion}")
        await asyncio.sleep(SETTLE_S)
        await listener.phase(phase, seconds)


async def reconnected(simulator: Simulator, listener: Listener, name: str) -> None:
    await simulator.say(f"unplug {name}")
    await listener.until(lambda: name not in listener.online)
    await asyncio.sleep(0.5)
    await simulator.say(f"plug {name}")
    await listener.connected({name})
    await listener.more_poses(30)


async def reloaded(station: Station, daemon: Child, listener: Listener) -> None:
    station.write_rig(
        ("output_rate_hz = 100", "output_rate_hz = 80"),
        ('id = "S3"\n', 'id = "S3"\nsilence_s = 0.8\n'),
    )
    hang_up(daemon)
    await listener.until(lambda: listener.said("demo", "configuration reloaded"))
    await listener.connected({*SENSORS, "mocap"})
    await listener.more_poses(80)


@pytest.mark.timeout(120)
async def test_a_run_with_calibration_reconnect_and_reload_replays_byte_for_byte(
    tmp_path: Path, broker: Broker
) -> None:
    station = Station(tmp_path, broker.port, more_toml="[recording]\n")
    async with running(station) as (simulator, daemon, listener):
        await calibrated(simulator, listener)
        assert listener.latest["calibration"]["phase"] == "calibrated"
        await reconnected(simulator, listener, "S1")
        await reloaded(station, daemon, listener)
        assert listener.latest["bridge/health"]["recording"]["failure"] is None
        code, _ = await stopped(daemon)
        assert code == 0, station.log
    for line in (
        "calibration align: ", "calibration aligned: ", "calibration posed: ",
        "calibration calibrated: calibrated", "stored as version 1 (version 1 in ",
    ):  # fmt: skip
        assert station.log.count(line) == 1, (line, station.log)
    assert "the worker said" not in station.log  # fits print nothing
    (log,) = (tmp_path / "state" / "recordings").iterdir()
    events = list(read_events(log))
    assert len([e for e in events if isinstance(e, Configured)]) == 2
    assert len([e for e in events if isinstance(e, JobFinished)]) == 3
    opened = [e.source for e in events if isinstance(e, SourceOpened)]
    assert (opened.count("S1"), opened.count("S2"), opened.count("S3")) == (2, 1, 2)
    assert {e.reason for e in events if isinstance(e, SourceClosed)} == {"lost", "removed"}
    live = list(read_states(log))
    assert len(live) > 2000
    assert [encode_state(state) for state in replay_states(events)] == live
