"""Scenes with prescribed clocks, scheduled commands and a log of sampling times."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import Any

import orjson
import pytest

from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.body import SimulatedSubject, parse_motion_script
from jointfit_simulators.devices import ClockFault, SampleTiming
from jointfit_simulators.scene import InvalidCommandError, Scene, SceneOptions
from jointfit_simulators.scene._sample_log import SampleLog
from jointfit_simulators.settings import Knobs

NOW = 10**13
"""Host time for objects that do not read the clock themselves, ns."""


def test_prescribed_clock_has_its_skew_and_uptime() -> None:
    timing = SampleTiming(Knobs(), "S1", latency_ms=2.0, now_ns=NOW)
    timing.set_fault(ClockFault.parse("50,3600"), NOW)
    assert timing.device_ns(NOW) == pytest.approx(3600 * NS_PER_S * (1 + 50e-6), abs=1)
    hour_later = timing.device_ns(NOW + 3600 * NS_PER_S) - timing.device_ns(NOW)
    assert hour_later == pytest.approx(3600 * NS_PER_S + 3600 * 50_000, abs=2)
    timing.reboot(NOW + NS_PER_S)
    assert timing.device_ns(NOW + 2 * NS_PER_S) == pytest.approx(NS_PER_S, abs=60_000)


def test_prescribed_skew_keeps_the_random_uptime() -> None:
    timing = SampleTiming(Knobs(), "S1", latency_ms=2.0, now_ns=NOW)
    boot_ns = timing.clock.boot_ns
    timing.set_fault(ClockFault.parse("-20"), NOW)
    assert timing.clock.boot_ns == boot_ns
    assert timing.clock.skew == pytest.approx(-20e-6)


def test_sample_log_contains_device_number_and_instant(tmp_path: Path) -> None:
    log = SampleLog(tmp_path / "samples.jsonl")
    log.add("S1", 65535, NOW)
    log.close()
    (line,) = (tmp_path / "samples.jsonl").read_bytes().splitlines()
    assert orjson.loads(line) == {"id": "S1", "number": 65535, "host_ns": NOW}


def scene(folder: Path, **options: Any) -> Scene:
    knobs = Knobs()
    subject = SimulatedSubject(knobs, parse_motion_script("stand"), motion_files={})
    now_ns = time.monotonic_ns()  # scheduled commands count from this time
    return Scene(knobs, subject, SceneOptions(folder, **options), now_ns=now_ns)


@pytest.mark.parametrize(
    ("options", "names"),
    [
        ({"wires": {"S9": "xbus"}}, "no sensor 'S9'; there are: S1"),
        ({"wires": {"S1": "nobus"}}, "no simulated IMU of driver 'nobus'; there are: .*xbus"),
        ({"mocap": "nocams"}, "no simulated cameras of driver 'nocams'; there are: .*natnet"),
    ],
)
def test_unknown_sensors_and_drivers_are_rejected(
    tmp_path: Path, options: dict[str, Any], names: str
) -> None:
    with pytest.raises(InvalidCommandError, match=names):
        scene(tmp_path, **options)


def test_a_sensor_has_the_chosen_driver_and_the_others_keep_theirs(tmp_path: Path) -> None:
    one = scene(tmp_path, wires={"S2": "xbus"}, mocap=None)
    assert set(one.ports) == {"S1", "S2", "S3", "S4", "can0"}
    assert one.ports["S2"] == str(tmp_path / "ttyS2")
    one.close()


def test_unknown_clocks_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(InvalidCommandError, match=r"S9.*there are: S1"):
        scene(tmp_path, clocks={"S9": ClockFault(1.0)})


async def test_scheduled_commands_run_in_time_and_their_errors_are_reported(tmp_path: Path) -> None:
    script = ((0.0, "reboot S9"), (0.0, "mocap restart"), (0.1, "quit"))
    reported: list[dict[str, object]] = []
    async with asyncio.timeout(10):
        await scene(tmp_path, script=script, sync_line=True).run(reported.append)
    assert [line for line in reported if "error" in line] == [
        {"error": "no sensor 'S9'; there are: S1, S2, S3, S4"}
    ]
    text = (tmp_path / "rig.toml").read_text(encoding="utf-8")
    assert text.count("trigger_indication") == 2
    assert text.count("sync_line = 0") == 1


def descriptors() -> set[str]:
    return {path.name for path in Path("/proc/self/fd").iterdir()}


async def test_cancelled_scene_closes_its_ports_and_files(tmp_path: Path) -> None:
    before = descriptors()
    ready = asyncio.Event()
    playing = asyncio.create_task(scene(tmp_path, sample_log=True).run(lambda _: ready.set()))
    await ready.wait()
    playing.cancel()
    await asyncio.wait([playing])
    assert descriptors() <= before
