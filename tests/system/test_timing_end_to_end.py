"""Real processes, clocks that drift and begin anew: no frame calls itself synced and is not."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from bench.stamp_truth import OPTICAL, WatchedCore, judge
from jointfit_daemon.outputs.event_log import encode_state, read_events, read_states
from tests.system.station import SENSORS, Listener, Station, running, stopped

if TYPE_CHECKING:
    from pathlib import Path

    from tests.broker_fixture import MosquittoBroker

pytestmark = pytest.mark.system

SKEWS_PPM = {"S1": 50, "S2": -50, "S3": 31, "S4": -23, OPTICAL: 42}
DELAY_MS = {"S1": 2.0, "S2": 1.0, "S3": 2.0, "S4": 1.0}
"""What the simulator's transports take at least; cameras answer echoes and need none."""
MOST_ERROR_NS = 500_000
EVERY = {*SENSORS, OPTICAL}
REBOOTED = "S1"


def locked(listener: Listener) -> bool:
    """Tell whether the newest pose calls itself synced and every clock agrees."""
    devices = listener.latest.get("bridge/health", {}).get("devices", {})
    states = {device.get("clock") for device in devices.values()}
    return (
        bool(listener.poses)
        and listener.poses[-1]["sync"] == "locked"
        and (len(devices) == len(EVERY) and "settling" not in states)
    )


async def recovers(listener: Listener, name: str) -> None:
    """Wait until a loss is seen, the device is there again, and everything is locked."""
    await listener.until(lambda: not locked(listener) or name not in listener.online, 10)
    before = listener.healths
    await listener.until(lambda: name in listener.online and listener.healths > before + 2, 15)
    await listener.until(lambda: locked(listener), 15)


@pytest.mark.timeout(90)
async def test_time_is_right_in_every_frame_that_says_so(
    tmp_path: Path, mosquitto: MosquittoBroker
) -> None:
    clocks = [word for id_, ppm in SKEWS_PPM.items() for word in ("--clock", f"{id_}={ppm}")]
    options = ("--sample-log", "--programme", "walk", *clocks)
    station = Station(tmp_path, mosquitto.port, options, more_toml="[recording]\n")
    async with running(station) as (simulator, daemon, listener):
        await listener.until(lambda: locked(listener), 20)
        for name in (REBOOTED, OPTICAL):
            await simulator.say(f"reboot {name}")
            await recovers(listener, name)
        await asyncio.sleep(2)
        code, _ = await stopped(daemon)
        assert code == 0, station.log
    (log,) = (tmp_path / "state" / "recordings").iterdir()
    core, states = judge(read_events(log), tmp_path / "samples.jsonl", DELAY_MS)
    assert [encode_state(state) for state in states] == list(read_states(log))
    check(core)


def check(core: WatchedCore) -> None:
    known = [sample for sample in core.samples if sample.error_ns is not None]
    assert len(known) > 0.99 * len(core.samples)
    wrong = [
        (sample.source, sample.error_ns) for sample in known
        if sample.synced and abs(sample.error_ns or 0) > MOST_ERROR_NS
    ]  # fmt: skip
    assert not wrong
    frames = [frame for frame in core.frames if frame.synced]
    assert len(frames) > 300
    assert max(frame.worst_ns for frame in frames) <= MOST_ERROR_NS
