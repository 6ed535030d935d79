"""``make endurance``: the daemon process in time that runs faster than real time, for many samples.

Four simulated sensors on serial lines, broker, daemon and listener run as in operation. The time of
the daemon and of the sensors is accelerated. Memory, file descriptors, threads, tasks, Python
objects, the age of poses, their error and the clocks of the sensors are measured at even intervals.
The command returns 1 if one of them has a slope, or if poses, clocks or counters are wrong.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import struct
import sys
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import load_rig
from jointfit_daemon.tools.child_processes import daemon
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators.devices import XbusDevice, XbusDeviceOptions
from tests.broker_fixture import chosen_broker
from tests.endurance.slopes import RESULTS, slope_of, table_of
from tests.faults.run import PAGE, render, stored
from tests.limb_model.plain_calibration import plain_calibration
from tests.system.station import OUTCOMES, Listener, broker

FOLDER = Path(__file__).parent
BASE = "jointfit/endurance"
SENSORS = ("S1", "S2", "S3", "S4")
RATE_HZ = 400
"""Sample rate of each sensor in accelerated time, Hz."""
PERIOD_NS = 1_000_000_000 // RATE_HZ
WAKE_S = 0.01
"""Time between two transmissions of the due samples, s of accelerated time."""
TURN_RAD_S = 0.8
"""Angular frequency of the movement, rad/s; its amplitude is 1 rad."""
INTERVALS = 240
"""Number of measurements of a run."""
ERROR = "median error of poses, deg"
MOST_ERROR_DEG = 3.0
"""Largest median error of an interval, deg. A batch of samples arrives late by its duration."""
RIG = """
[rig]
name = "endurance"
[chain]
joints = ["hip", "knee"]
segments = ["thigh"]
[mqtt]
host = "127.0.0.1"
port = {port}
base = "{base}"
health_s = {health_s}
[recording]
directory = "{folder}/recordings"
file_minutes = 5
keep_gb = 0.2
"""
IMU = """
[[imu]]
id = "{name}"
segment = "thigh"
driver = "xbus"
port = "{folder}/{name}"
baud = 921600
rate_hz = {rate_hz}
silence_s = {silence_s}
"""


@dataclass
class Movement:
    """Sensors that move in accelerated time."""

    folder: Path
    factor: int
    begin_ns: int = field(default_factory=time.monotonic_ns)
    number: int = 0

    def __post_init__(self) -> None:
        outputs = (*XbusDeviceOptions().outputs[:-1], (Item.QUATERNION, RATE_HZ))
        options = XbusDeviceOptions(outputs=outputs)
        self.devices = [XbusDevice(self.folder / name, options=options) for name in SENSORS]
        self.unix_ns = time.time_ns() - self.begin_ns

    def now_ns(self) -> int:
        """Return the accelerated time, ns."""
        return self.begin_ns + (time.monotonic_ns() - self.begin_ns) * self.factor

    def angle(self, t_ns: int) -> float:
        """Return the angle of all sensors at an accelerated time, rad."""
        return math.sin(TURN_RAD_S * (t_ns - self.begin_ns) * 1e-9)

    def error_deg(self, pose: dict[str, Any]) -> float | None:
        """Return the error of a pose; None without an orientation."""
        q = pose["segments"]["thigh"]["q"]
        if q is None:
            return None
        angle = 2.0 * math.atan2(q[1], q[0])
        truth = self.angle(pose["t_us"] * 1000 - self.unix_ns)
        return abs(math.degrees(math.remainder(angle - truth, 2.0 * math.pi)))

    async def run(self) -> None:
        """Send samples until cancelled."""
        serving = [asyncio.create_task(device.run()) for device in self.devices]
        try:
            while True:
                due = (self.now_ns() - self.begin_ns) // PERIOD_NS
                while self.number < due:
                    self.number += 1
                    t_ns = self.begin_ns + self.number * PERIOD_NS
                    half = self.angle(t_ns) / 2
                    q = (math.cos(half), math.sin(half), 0.0, 0.0)
                    for device in self.devices:
                        device.push(t_ns - self.begin_ns, q)
                await asyncio.sleep(WAKE_S / self.factor)
        finally:
            for task in serving:
                task.cancel()
            await asyncio.wait(serving)
            for device in self.devices:
                device.unplug()


def process_values(pid: int, counts: Path) -> dict[str, float]:
    """Return the values that the kernel and the process count."""
    place = Path(f"/proc/{pid}")
    tasks, objects = struct.unpack("<qq", counts.read_bytes())
    pages = int((place / "statm").read_text("ascii").split()[1])
    return {
        "memory, MB": pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        "file descriptors": len(list((place / "fd").iterdir())),
        "threads": len(list((place / "task").iterdir())),
        "asyncio tasks": tasks,
        "Python objects": objects,
    }


def daemon_values(listener: Listener, movement: Movement) -> dict[str, float]:
    """Return the values in the messages of an interval."""
    poses, health = listener.poses, listener.latest["bridge/health"]
    errors = sorted(e for e in map(movement.error_deg, poses) if e is not None)
    devices = [health["devices"][name] for name in SENSORS]
    return {
        ERROR: errors[len(errors) // 2] if errors else math.nan,
        "age of samples, ms": max(device["delay_us"]["p50"] for device in devices) / 1000,
        "skew of the clocks, ppm": max(
            (math.nan if device["skew_ppm"] is None else device["skew_ppm"] for device in devices),
            key=abs,
        ),
    }


async def measure(
    folder: Path, port: int, samples: int, factor: int, seconds: float
) -> list[dict[str, float]]:
    """Run until `samples` were received or `seconds` have passed; return the measurements."""
    movement = Movement(folder, factor)
    text = RIG.format(port=port, base=BASE, folder=folder, health_s=5)
    # The time limit is a second of real time, because this machine pauses processes for tenths of a
    # second.
    line = {"folder": folder, "rate_hz": RATE_HZ, "silence_s": factor}
    text += "".join(IMU.format(name=name, **line) for name in SENSORS)
    (folder / "rig.toml").write_text(text, "utf-8")
    rig = load_rig(folder / "rig.toml")
    CalibrationStore(folder / "state" / "calibrations", rig.calibration_store).save(
        plain_calibration(rig.chain)
    )
    counts = folder / "counts"
    counts.write_bytes(bytes(16))
    child = daemon(folder, folder / "rig.toml")
    child.environment |= {
        "PYTHONPATH": str(FOLDER / "fast_time"),
        "ENDURANCE": f"{counts}:{factor}:{movement.begin_ns}",
    }
    listener = Listener(broker(port, BASE), ("pose", "bridge/health", "device/+/availability"))
    tasks = [asyncio.create_task(part.run()) for part in (movement, listener)]
    found: list[dict[str, float]] = []
    try:
        async with child:
            await listener.connected(SENSORS)
            await listener.health(lambda devices: all(d["skew_ppm"] for d in devices.values()))
            until_s = time.monotonic() + seconds
            per_s = RATE_HZ * len(SENSORS) * factor
            pause_s = min(seconds, samples / per_s) / INTERVALS
            while time.monotonic() < until_s and received(listener) < samples:
                listener.poses.clear()
                await asyncio.sleep(pause_s)
                child.check()
                assert child.process is not None
                row = {"samples": float(received(listener))}
                row |= process_values(child.process.pid, counts)
                row |= daemon_values(listener, movement)
                if not any(map(math.isnan, row.values())):  # otherwise, this machine paused
                    found.append(row)
            check_counters(listener, movement)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        print(child.tail(), file=sys.stderr)
    return found


def received(listener: Listener) -> int:
    """Return the number of samples that the daemon has received."""
    devices = listener.latest["bridge/health"]["devices"]
    return sum(devices[name]["received"] for name in SENSORS)


def check_counters(listener: Listener, movement: Movement) -> None:
    """Require that every sample has an outcome; print the interruptions by this machine."""
    interruptions = 0
    for name in SENSORS:
        device = listener.latest["bridge/health"]["devices"][name]
        outcomes = sum(device[key] for key in OUTCOMES) + device["pending"]
        assert outcomes == device["received"], (name, device)
        interruptions += device["restarts"] + device["reconnects"]
    print(f"{movement.number} samples sent by each sensor, {interruptions} reconnects or restarts")


def results_of(found: list[dict[str, float]], factor: int) -> dict[str, Any]:
    """Return the slopes of a run, for the page."""
    samples = [row["samples"] for row in found]
    names = [name for name in found[0] if name != "samples"]
    slopes = {name: slope_of(samples, [row[name] for row in found], len(names)) for name in names}
    return {
        "samples": int(samples[-1]),
        "factor": factor,
        "measurements": len(found),
        "worst_error_deg": round(max(row[ERROR] for row in found[len(found) // 4 :]), 2),
        "slopes": {
            name: {"mean": s.mean, "per_million": s.per_million, "half_width": s.half_width}
            for name, s in slopes.items()
        },
    }


def faults_of(results: dict[str, Any]) -> list[str]:
    """Return the values that grow or are wrong."""
    faults = [
        f"{name} has a slope of {slope['per_million']:+.3g} ± {slope['half_width']:.2g} per million"
        for name, slope in results["slopes"].items()
        if abs(slope["per_million"]) > slope["half_width"]
    ]
    if results["worst_error_deg"] > MOST_ERROR_DEG:
        faults.append(f"{ERROR}: {results['worst_error_deg']}, limit {MOST_ERROR_DEG:g}")
    return faults


def main() -> int:
    """Run the test; return 1 if a value has a slope."""
    parser = argparse.ArgumentParser(prog="make endurance", description=__doc__)
    parser.add_argument("--samples", type=int, default=50_000_000, help="samples of all sensors")
    parser.add_argument("--factor", type=int, default=10, help="times real time")
    parser.add_argument("--minutes", type=float, default=600.0, help="longest real time")
    parser.add_argument("--out", type=Path, help="file for the measurements, JSON")
    parser.add_argument("--store", action="store_true", help="store the slopes for the page")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        chosen = chosen_broker()(Path(name))
        chosen.start()
        try:
            limits = options.samples, options.factor, 60.0 * options.minutes
            found = asyncio.run(measure(Path(name), chosen.port, *limits))
        finally:
            chosen.stop()
    if options.out is not None:
        options.out.write_text(json.dumps(found) + "\n", "utf-8")
    results = results_of(found, options.factor)
    print(table_of(results))
    if options.store:
        RESULTS.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n", "utf-8")
        PAGE.write_text(render(stored()), "utf-8")
    faults = faults_of(results)
    print("\n".join(faults) or "nothing grows")
    return 1 if faults else 0


sys.exit(main())
