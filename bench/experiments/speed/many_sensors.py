"""Running daemon with many sensors or fast sensors: no sample may be lost or have no outcome."""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from bench.experiments.speed.gateway import played
from bench.framework.measurement import percentile, speed_experiment, timed_result
from bench.rigs.gateway import cpu_s, daemon_variant, rss_mb, subscriber, unaccounted
from bench.rigs.many_sensors import sensor_names
from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import load_rig
from tests.broker_fixture import MosquittoBroker
from tests.compiled_variant import is_current
from tests.limb_model.plain_calibration import plain_calibration

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from bench.framework.experiment import Result

SECONDS, QUICK_S = 30.0, 4.0
SETTLE_S, CONNECT_S = 4.0, 40.0
DRAIN_S = 2.0
"""Time after the last sample in which the daemon counts all samples, s."""
RIG = """
[rig]
name = "many-sensors"
[chain]
joints = ["hip", "knee", "ankle"]
segments = ["thigh", "shank"]
[mqtt]
host = "127.0.0.1"
port = {port}
base = "jointfit/many-sensors"
health_s = 0.5
"""
IMU = """
[[imu]]
id = "{name}"
segment = "{segment}"
driver = "mip"
estimator = "sensor"
port = "{folder}/{name}"
transport = "usb"
rate_hz = {rate_hz:g}
silence_s = 30
"""


@dataclass(frozen=True)
class Sensors:
    """Number of sensors, half of them on each segment, and their sample rate."""

    number: int
    rate_hz: float


SENSORS = (Sensors(8, 1000.0), Sensors(32, 100.0))


@dataclass(frozen=True)
class Figures:
    """Results of one run."""

    samples: int
    missing: int
    """Number of samples that were sent but not received, were dropped, or have no outcome."""
    late: int
    cpu_s: float
    rss_mb: float
    latencies_ms: list[float]


@contextlib.asynccontextmanager
async def sensor_process(
    folder: Path, sensors: Sensors
) -> AsyncIterator[asyncio.subprocess.Process]:
    """Run the process of the sensors."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "bench.rigs.many_sensors", str(folder), str(sensors.number),
        str(sensors.rate_hz), stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip
    try:
        yield process
    finally:
        process.kill()
        await process.wait()


def write_rig(folder: Path, port: int, sensors: Sensors) -> Path:
    """Write rig.toml and a calibration; return the path of rig.toml."""
    text = RIG.format(port=port)
    for k, name in enumerate(sensor_names(sensors.number)):
        segment = ("thigh", "shank")[k % 2]
        text += IMU.format(name=name, segment=segment, folder=folder, rate_hz=sensors.rate_hz)
    path = folder / "rig.toml"
    path.write_text(text, "utf-8")
    rig = load_rig(path)
    store = CalibrationStore(folder / "state" / "calibrations", rig.calibration_store)
    store.save(plain_calibration(rig.chain))
    return path


async def measure(
    folder: Path, port: int, sensors: Sensors, seconds: float, *, compiled: bool
) -> Figures:
    """Run sensors and daemon for `seconds`; return the results."""
    path = write_rig(folder, port, sensors)
    rig = load_rig(path)
    names = set(sensor_names(sensors.number))
    async with (
        sensor_process(folder, sensors) as process,
        subscriber(rig.mqtt) as heard,
        daemon_variant(folder, path, compiled=compiled) as child,
    ):
        assert child.process is not None
        async with asyncio.timeout(CONNECT_S):
            while not heard.online >= names:
                child.check()
                await asyncio.sleep(0.05)
        await asyncio.sleep(SETTLE_S)

        heard.latencies_ms.clear()
        began_s, began_cpu_s = time.monotonic(), cpu_s(child.process.pid)
        before = heard.health["devices"]
        await asyncio.sleep(seconds)
        took_s, spent_s = time.monotonic() - began_s, cpu_s(child.process.pid) - began_cpu_s
        latencies_ms = heard.latencies_ms[:]

        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(b"\n")
        sent = json.loads(await process.stdout.readline())
        await asyncio.sleep(DRAIN_S)
        devices = heard.health["devices"]
        return Figures(
            sum(devices[name]["received"] for name in names),
            unaccounted(sent, devices) + sum(devices[name]["dropped"] for name in names),
            sum(devices[name]["late"] - before[name]["late"] for name in names),
            spent_s / took_s,
            rss_mb(child.process.pid),
            latencies_ms,
        )


def rows(quick: bool) -> list[Result]:
    """Return losses, CPU share, memory and latency of each rig, with and without compilation."""
    if (reason := MosquittoBroker.missing()) is not None:
        print(f"not run: {reason}", file=sys.stderr)
        return []
    variants = {"sources": False}
    if is_current():
        variants["compiled"] = True
    else:
        print("many-sensors: run `make compiled` for the compiled modules", file=sys.stderr)

    found = []
    for sensors in SENSORS:
        for variant, compiled in variants.items():
            if quick and compiled:
                continue
            seconds = QUICK_S if quick else SECONDS
            play = partial(measure, sensors=sensors, seconds=seconds, compiled=compiled)
            figures = played("mosquitto", play)
            assert figures is not None
            found += _rows_of(f"{sensors.number} × {sensors.rate_hz:g} Hz, {variant}", figures)
    return found


def _rows_of(title: str, found: Figures) -> list[Result]:
    ms = found.latencies_ms
    return [
        timed_result(
            f"{title}: samples missing", found.missing, "", 0, 0,
            note=f"of {found.samples}; {found.late} late",
        ),
        timed_result(f"{title}: CPU of the daemon", round(100 * found.cpu_s, 1), "% of a core"),
        timed_result(f"{title}: memory of the daemon", round(found.rss_mb, 1), "MB"),
        timed_result(f"{title}: latency, median", round(percentile(ms, 0.5), 2), "ms"),
        timed_result(
            f"{title}: latency, p99", round(percentile(ms, 0.99), 2), "ms", note=f"{len(ms)} frames"
        ),
    ]  # fmt: skip


EXPERIMENTS = (
    speed_experiment(
        "many-sensors",
        "Processes: eight sensors at 1000 Hz, and 32 sensors at 100 Hz, mosquitto",
        rows,
    ),
)
