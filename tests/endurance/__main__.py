"""``make endurance``: runs the daemon process in accelerated time, for many samples.

Four simulated sensors on serial lines, broker, daemon and listener run as in operation. The time of
the daemon and of the sensors is accelerated. Memory, file descriptors, threads, tasks, Python
objects, the age of samples, the error of poses and the clock skew are measured at even intervals.
The command returns 1 if the confidence interval of a slope does not contain zero, or if poses,
clocks or counters are wrong.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import struct
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jointfit_daemon.calibration.record import CalibrationStore
from jointfit_daemon.config import load_rig
from jointfit_daemon.tools.child_processes import ChildProcess, daemon
from tests.broker_fixture import chosen_broker
from tests.compiled_variant import is_current
from tests.endurance.sensors import RATE_HZ, SENSORS, Movement
from tests.endurance.slopes import ERROR, RESULTS, faults_of, slope_of, table_of, warning_of
from tests.faults.run import PAGE, render, stored
from tests.limb_model.plain_calibration import plain_calibration
from tests.system.station import OUTCOMES, Listener, broker

if TYPE_CHECKING:
    from collections.abc import Sequence

FOLDER = Path(__file__).parent
ROOT = FOLDER.parents[1]
BASE = "jointfit/endurance"
INTERVALS = 240
"""Number of measurements of a run."""
COUNTERS = ("received", "lost", "late", "dropped", "restarts", "reconnects")
RIG = """
[rig]
name = "endurance"
output_rate_hz = 50
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


def error_deg(pose: dict[str, Any], movement: Movement, unix_ns: int) -> float | None:
    """Return the error of a pose, deg, for a movement since `unix_ns`; None if it is unknown."""
    q = pose["segments"]["thigh"]["q"]
    if q is None:
        return None
    angle = 2.0 * math.atan2(q[1], q[0])
    truth = movement.angle(pose["t_us"] * 1000 - unix_ns)
    return abs(math.degrees(math.remainder(angle - truth, 2.0 * math.pi)))


def process_values(pid: int, counts: Path) -> dict[str, float]:
    """Return the values that the kernel and the process count."""
    place = Path(f"/proc/{pid}")
    tasks, objects, allocated = struct.unpack("<qqq", counts.read_bytes())
    pages = int((place / "statm").read_text("ascii").split()[1])
    return {
        "memory, MB": pages * os.sysconf("SC_PAGE_SIZE") / 1e6,
        "memory allocated by malloc, MB": allocated / 1e6,
        "file descriptors": len(list((place / "fd").iterdir())),
        "threads": len(list((place / "task").iterdir())),
        "asyncio tasks": tasks,
        "Python objects": objects,
    }


def daemon_values(listener: Listener, movement: Movement, unix_ns: int) -> dict[str, float]:
    """Return the values that the messages of the daemon contain since the last measurement."""
    health = listener.latest["bridge/health"]
    errors = sorted(
        error
        for pose in listener.poses
        if (error := error_deg(pose, movement, unix_ns)) is not None
    )
    devices = [health["devices"][name] for name in SENSORS]
    return {
        ERROR: errors[len(errors) // 2] if errors else math.nan,
        "age of samples, ms": max(device["delay_us"]["p50"] for device in devices) / 1000,
        "skew of the clocks, ppm": largest_skew_ppm([device["skew_ppm"] for device in devices]),
    }


def largest_skew_ppm(skews: Sequence[float | None]) -> float:
    """Return the skew with the largest absolute value, ppm; NaN if a skew is unknown."""
    known = [skew for skew in skews if skew is not None]
    return max(known, key=abs) if len(known) == len(skews) else math.nan


def daemon_process(folder: Path, movement: Movement, *, compiled: bool) -> ChildProcess:
    """Return the daemon in accelerated time, on the compiled modules or on the sources.

    Raises
    ------
    SystemExit
        The compiled modules are missing or older than the sources.
    """
    child = daemon(folder, folder / "rig.toml")
    paths = [str(FOLDER / "fast_time")]
    if compiled:
        if not is_current():
            sys.exit("build/compiled does not contain the current sources: run `make compiled`")
        paths.append(str(ROOT / "build" / "compiled"))
    counts = folder / "counts"
    counts.write_bytes(bytes(24))
    child.environment |= {
        "PYTHONPATH": os.pathsep.join(paths),
        "PYTHONSAFEPATH": "1",  # the current folder contains the sources
        "ENDURANCE": f"{counts}:{movement.factor}:{movement.begin_ns}",
    }
    return child


def variant_of(child: ChildProcess) -> str:
    """Return the form of the modules that the daemon imports: compiled or pure."""
    version = subprocess.run(
        [*child.arguments[:3], "--version"], env=os.environ | child.environment,
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    return version.partition("(")[2].rstrip(")\n")


def write_rig(folder: Path, port: int, factor: int) -> None:
    """Write rig.toml and a calibration of its chain."""
    text = RIG.format(port=port, base=BASE, folder=folder, health_s=5)
    # The limit `silence_s` is one second of real time, because a loaded machine pauses processes
    # for tenths of a second.
    line = {"folder": folder, "rate_hz": RATE_HZ, "silence_s": factor}
    text += "".join(IMU.format(name=name, **line) for name in SENSORS)
    (folder / "rig.toml").write_text(text, "utf-8")
    rig = load_rig(folder / "rig.toml")
    store = CalibrationStore(folder / "state" / "calibrations", rig.calibration_store)
    store.save(plain_calibration(rig.chain))


async def measure(
    folder: Path, port: int, options: argparse.Namespace
) -> tuple[list[dict[str, float]], dict[str, int], str]:
    """Run until the samples were received or the time has passed.

    Returns the measurements, the sums of the counters of all sensors, and the variant of the
    daemon.
    """
    movement = Movement(options.factor)
    unix_ns = time.time_ns() - time.monotonic_ns() + movement.begin_ns
    write_rig(folder, port, options.factor)
    words = [str(folder), str(movement.factor), str(movement.begin_ns)]
    command = [sys.executable, "-m", "tests.endurance.sensors", *words]
    sensors = ChildProcess("sensors", command, folder, {})
    child = daemon_process(folder, movement, compiled=options.compiled)
    listener = Listener(broker(port, BASE), ("pose", "bridge/health", "device/+/availability"))

    def are_settled() -> bool:
        sensors.check()
        child.check()
        health = listener.latest.get("bridge/health", {"devices": {}})["devices"]
        return health.keys() >= set(SENSORS) and all(d["skew_ppm"] for d in health.values())

    task = asyncio.create_task(listener.run())
    found: list[dict[str, float]] = []
    seconds = min(60.0 * options.minutes, options.samples / movement.samples_per_s)
    try:
        async with sensors, child:
            await listener.until(are_settled)
            assert child.process is not None
            until_s = time.monotonic() + 60.0 * options.minutes
            while time.monotonic() < until_s and received(listener) < options.samples:
                listener.poses.clear()
                await asyncio.sleep(seconds / INTERVALS)
                sensors.check()
                child.check()
                row = {"samples": float(received(listener))}
                row |= process_values(child.process.pid, folder / "counts")
                row |= daemon_values(listener, movement, unix_ns)
                if not any(map(math.isnan, row.values())):  # NaN: no pose or no clock
                    found.append(row)
                    append(row, options.out)
    finally:
        task.cancel()
        await asyncio.wait([task])
        print(sensors.tail(), child.tail(), sep="\n", file=sys.stderr)
    return found, counters_of(listener), variant_of(child)


def append(row: dict[str, float], out: Path | None) -> None:
    """Append a measurement to the file, if there is one."""
    if out is not None:
        with out.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")


def received(listener: Listener) -> int:
    """Return the number of samples that the daemon has received."""
    devices = listener.latest["bridge/health"]["devices"]
    return sum(devices[name]["received"] for name in SENSORS)


def counters_of(listener: Listener) -> dict[str, int]:
    """Return the sums of the counters of all sensors, and of the samples without an outcome."""
    devices = [listener.latest["bridge/health"]["devices"][name] for name in SENSORS]
    sums = {key: sum(device[key] for device in devices) for key in COUNTERS}
    outcomes = sum(device[key] for device in devices for key in (*OUTCOMES, "pending"))
    return sums | {"unaccounted": sum(device["received"] for device in devices) - outcomes}


def results_of(
    found: list[dict[str, float]], counters: dict[str, int], variant: str, factor: int
) -> dict[str, Any]:
    """Return the slopes and counters of a run, which are stored for docs/reliability.md."""
    samples = [row["samples"] for row in found]
    names = [name for name in found[0] if name != "samples"]
    slopes = {name: slope_of(samples, [row[name] for row in found], len(names)) for name in names}
    return {
        "samples": int(samples[-1]),
        "factor": factor,
        "variant": variant,
        "measurements": len(found),
        "counters": counters,
        "worst_error_deg": round(max(row[ERROR] for row in found[len(found) // 4 :]), 2),
        "slopes": {
            name: {"mean": s.mean, "per_million": s.per_million, "half_width": s.half_width}
            for name, s in slopes.items()
        },
    }


def main() -> int:
    """Run the test; return 1 if there are faults (`faults_of`)."""
    parser = argparse.ArgumentParser(prog="make endurance", description=__doc__)
    parser.add_argument("--samples", type=int, default=50_000_000, help="samples of all sensors")
    parser.add_argument("--factor", type=int, default=10, help="speed of the accelerated time")
    parser.add_argument("--minutes", type=float, default=600.0, help="limit of the real time")
    parser.add_argument("--compiled", action="store_true", help="use the compiled modules")
    parser.add_argument("--out", type=Path, help="file for the measurements, JSON lines")
    parser.add_argument("--store", action="store_true", help="store the slopes for the page")
    options = parser.parse_args()
    for name in ("samples", "factor", "minutes"):
        if not getattr(options, name) > 0:
            parser.error(f"--{name}: expected a number above 0, got {getattr(options, name)}")
    with tempfile.TemporaryDirectory() as name:
        chosen = chosen_broker()(Path(name))
        chosen.start()
        try:
            found, counters, variant = asyncio.run(measure(Path(name), chosen.port, options))
        finally:
            chosen.stop()
    results = results_of(found, counters, variant, options.factor)
    print(table_of(results))
    print(", ".join(f"{count} {key}" for key, count in counters.items()))
    if warning := warning_of(results["samples"]):
        print(f"warning: {warning}")
    if options.store:
        RESULTS.write_text(json.dumps(results, indent=1, sort_keys=True) + "\n", "utf-8")
        PAGE.write_text(render(stored()), "utf-8")
    faults = faults_of(results)
    print("\n".join(faults) or "nothing grows")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
