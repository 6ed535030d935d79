"""The checks of the request ``selftest``: devices, clocks, calibration, broker and host.

Invariant: every check has one line in the result, and every line whose level is not ``ok`` contains
a remedy.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jointfit_daemon.device_search import Finding
from jointfit_daemon.driver import device_path
from jointfit_daemon.pipeline.health import MOST_LOST
from jointfit_daemon.supervisor.state_directory import WRITE_REMEDY, write_fault

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.config import Rig, Source
    from jointfit_daemon.device_search import Level
    from jointfit_daemon.outputs.payloads import BridgeHealth
    from jointfit_daemon.pipeline.health import DeviceHealth

LEAST_RATE = 0.95
"""Share of the configured sample rate below which a device is reported."""
MOST_DROPPED = 0.05
"""Ratio of dropped to sent messages above which the connection is reported. At every start, some
poses are dropped before the connection exists."""
CLOCK_SIGMA_NS = 2e6
"""Standard deviation of a stamp above which a clock is reported, ns."""
LOOP_DELAY_MS = 20.0
"""Delay of the event loop above which the process is reported, ms."""
LOW_DISK_BYTES, LEAST_DISK_BYTES = 1_000_000_000, 50_000_000
"""Free space below which the disk is reported as a warning and as an error, bytes."""
HOT_C = 80.0
"""Processor temperature above which the host is reported, °C. A Raspberry Pi reduces its clock rate
at 80 °C."""
_THERMAL = Path("/sys/class/thermal")


@dataclass(frozen=True, slots=True)
class HostState:
    """State of the host: disk, state directory and temperature."""

    store_fault: str | None
    """Reason why the daemon cannot write to the state directory; None if it can."""
    free_bytes: int | None
    temperature_c: float | None
    """Highest temperature of the processor, °C; None if unknown."""


def read_host(folder: Path) -> HostState:
    """Return the state of the host; call this function in a thread.

    `folder` is the folder of the calibrations.
    """
    fault, free = write_fault(folder), None
    for place in (folder, *folder.absolute().parents):
        if place.is_dir():
            free = shutil.disk_usage(place).free
            break

    found = []
    for path in _THERMAL.glob("thermal_zone*/temp"):
        try:
            found.append(int(path.read_text(encoding="ascii")) / 1000.0)
        except (OSError, ValueError):
            continue  # a thermal zone that is switched off
    return HostState(fault, free, max(found, default=None))


def self_test(rig: Rig, health: BridgeHealth, host: HostState) -> list[Finding]:
    """Return the result of every check.

    Parameters
    ----------
    rig
        The current rig.
    health
        Counters and clocks of this instant.
    host
        State of disk, store and processor temperature.
    """
    return [
        *_devices(rig, health),
        *_calibration(rig, health),
        *_store(host, health),
        *_broker(health),
        *_process(health, host),
    ]


def _devices(rig: Rig, health: BridgeHealth) -> Iterator[Finding]:
    for source in rig.sources:
        device = health.core.devices.get(source.id)
        if device is None:
            yield Finding("device", source.id, "error", "not started", "send the request again")
            continue
        yield _device(source, device)
        if device.online:
            yield _clock(source, device)


def _device(source: Source, device: DeviceHealth) -> Finding:
    name, wire, rate_hz = source.id, device.wire, device.clock.rate_hz
    port = device_path(source.settings) or getattr(source.settings, "server", None)
    place = f" at {port}" if port else ""
    if not device.online:
        silent = "" if device.silent_ns is None else f" for {device.silent_ns / 1e9:.0f} s"
        return Finding(
            "device", name, "error", f"no data{silent or ' since the start'}{place}",
            f"check power and cable{place}; the last event of {name} on bridge/event names the "
            "cause",
        )  # fmt: skip
    if device.sensor == "stuck":
        remedy = (
            "restart the device: switch its power off and on, or send the request restart-device "
            f'{{"device":"{name}"}}'
        )
        return Finding("device", name, "error", "repeats its value while others move", remedy)

    bad = wire.lost + wire.corrupt
    if bad > MOST_LOST * max(1, wire.received + wire.lost):
        return Finding(
            "device", name, "warning",
            f"{wire.lost} samples lost and {wire.corrupt} runs of corrupt bytes among "
            f"{wire.received} samples",
            f"check cable, plug and shield{place}, and that the line is fast enough for the rate",
        )  # fmt: skip
    if source.kind == "imu" and rate_hz is not None and rate_hz < LEAST_RATE * source.rate_hz:
        return Finding(
            "device", name, "warning",
            f"{rate_hz:.1f} samples a second, expected {source.rate_hz:g}",
            "set rate_hz to the rate that the device is configured for, or configure the device",
        )  # fmt: skip
    shown = "" if rate_hz is None else f", {rate_hz:.1f} Hz"
    return Finding("device", name, "ok", f"streaming{shown}")


def _clock(source: Source, device: DeviceHealth) -> Finding:
    name, clock = source.id, device.clock
    text = f"clock {clock.state}"
    if clock.sigma_ns is not None:
        text += f", stamps ± {clock.sigma_ns / 1e6:.2f} ms"
    if clock.state == "settling":
        return Finding("clock", name, "warning", text, "wait some seconds, and repeat the test")
    if clock.state == "stale":
        remedy = "check the network to the server: round trips stopped"
        return Finding("clock", name, "warning", text, remedy)
    if clock.sigma_ns is not None and clock.sigma_ns > CLOCK_SIGMA_NS:
        remedy = "connect the device without a hub, or use a synchronization line (docs: Time)"
        return Finding("clock", name, "warning", text, remedy)
    return Finding("clock", name, "ok", text)


def _calibration(rig: Rig, health: BridgeHealth) -> Iterator[Finding]:
    core = health.core
    if core.phase == "uncalibrated":
        remedy = "calibrate: jointfit calibrate, or the request calibrate"
        yield Finding("calibration", "", "error", "no calibration is in force", remedy)
        return
    if (reason := health.state.not_stored) is not None:
        yield Finding("calibration", "", "error", f"not stored: {reason}", WRITE_REMEDY)
    else:
        version = "" if core.version is None else f", version {core.version}"
        yield Finding("calibration", "", "ok", f"{core.phase}{version}")

    if all(source.kind != "mocap" for source in rig.sources):
        return
    for name, lag in core.lags.items():
        if lag.source == "none":
            yield Finding(
                "lag", name, "warning",
                "lag behind the cameras unknown: 0 is subtracted from the stamps",
                "repeat the functional phase with faster movements, or set lag_ms",
            )  # fmt: skip
        elif not lag.used_ns and lag.found_by in (None, "none") and lag.source == "calibration":
            yield Finding("lag", name, "ok", "no lag determined (assumed 0 ms)")
        elif lag.used_ns is not None:
            yield Finding(
                "lag", name, "ok", f"lag {lag.used_ns * 1e-6:.1f} ms, source: {lag.source}"
            )


def _store(host: HostState, health: BridgeHealth) -> Iterator[Finding]:
    if host.store_fault is None:
        yield Finding("store", "", "ok", "calibrations can be written")
    else:
        yield Finding("store", "", "error", f"cannot be written: {host.store_fault}", WRITE_REMEDY)

    free = host.free_bytes
    remedy = "delete old recordings, or use a larger medium"
    if free is not None:
        level: Level = "ok" if free > LOW_DISK_BYTES else "warning"
        level = level if free > LEAST_DISK_BYTES else "error"
        text = f"{free / 1e9:.1f} GB free"
        yield Finding("disk", "", level, text, "" if level == "ok" else remedy)

    recording = health.recording
    if recording is not None and recording.active and recording.failure is not None:
        text = f"interrupted, {recording.lost} messages lost: {recording.failure}"
        yield Finding("recording", "", "error", text, f"{remedy}; the recording resumes by itself")
    elif recording is not None and recording.active:
        yield Finding("recording", "", "ok", f"{recording.file}, {recording.written_bytes} bytes")


def _broker(health: BridgeHealth) -> Iterator[Finding]:
    link = health.link
    if link.denied:
        text = f"the broker refuses {', '.join(link.denied)}"
        remedy = "allow these topics for the daemon in the access list of the broker"
        yield Finding("broker", "", "error", text, remedy)
    elif link.dropped > MOST_DROPPED * link.sent:
        text = f"{link.dropped} messages were dropped since the start, {link.sent} sent"
        remedy = "check the network to the broker and its load"
        yield Finding("broker", "", "warning", text, remedy)
    else:
        yield Finding("broker", "", "ok", f"connected, {link.sent} messages sent")


def _process(health: BridgeHealth, host: HostState) -> Iterator[Finding]:
    delay_ms = health.process.loop_delay_p99_ms
    if delay_ms is not None:
        busy = delay_ms > LOOP_DELAY_MS
        remedy = "stop other programs, or lower output_rate_hz" if busy else ""
        text = f"delay of the event loop {delay_ms:.1f} ms (p99 of the last minute)"
        yield Finding("process", "", "warning" if busy else "ok", text, remedy)
    if host.temperature_c is not None:
        hot = host.temperature_c > HOT_C
        remedy = "cool the gateway: the processor slows down" if hot else ""
        text = f"{host.temperature_c:.0f} °C"
        yield Finding("temperature", "", "warning" if hot else "ok", text, remedy)


def result_of(checks: list[Finding]) -> dict[str, Any]:
    """Return the data of the answer: the most severe level, and one line for each check."""
    levels = {check.level for check in checks}
    worst = next((level for level in ("error", "warning") if level in levels), "ok")
    return {
        "level": worst,
        "checks": [
            {
                "check": check.check,
                "id": check.id,
                "level": check.level,
                "text": check.text,
                "remedy": check.remedy,
            }
            for check in checks
        ],
    }
