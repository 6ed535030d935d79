"""Health of the daemon as metric families, with names and units by the conventions of Prometheus.

Invariant: units are base units (seconds, bytes, hertz), and only counters end in ``_total``.
Unknown values are absent, never 0. docs/integrations.md lists every family.
"""

from __future__ import annotations

import os
import time
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, get_args

from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    StateSetMetricFamily,
)

from jointfit_daemon import __version__
from jointfit_daemon.fusion.faults import SensorState
from jointfit_daemon.outputs.metrics._frame_statistics import LATENCY_LIMITS_S
from jointfit_daemon.pipeline.events import CalibrationPhase
from jointfit_daemon.units import S_PER_NS

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping

    from prometheus_client.core import Metric

    from jointfit_daemon.outputs.metrics._frame_statistics import FrameStatistics
    from jointfit_daemon.outputs.payloads import BridgeHealth
    from jointfit_daemon.pipeline.health import DeviceHealth

_CLOCK_STATES = ("settling", "direct", "echo", "passive", "arrival", "stale")
_START_FIELD = 19
"""Index of the start time, which is in clock ticks, among the fields of /proc/self/stat after the
name of the program."""
_Device = dict[str, tuple[str, "Callable[[DeviceHealth], float | None]"]]

_COUNTERS: _Device = {
    "received_samples": ("Samples decoded.", lambda d: d.wire.received),
    "lost_samples": (
        "Samples that the device counted but that did not arrive.",
        lambda d: d.wire.lost,
    ),
    "corrupt_runs": ("Runs of bytes that form no valid message.", lambda d: d.wire.corrupt),
    "discarded_bytes": ("Bytes that form no valid message.", lambda d: d.wire.discarded_bytes),
    "restarts": ("Restarts of the device.", lambda d: d.wire.restarts),
    "reconnects": (
        "Times the device was opened again.",
        lambda d: max(0, d.wire.opened - 1),
    ),
}
"""Counters of a device, by name without prefix and suffix."""

_GAUGES: _Device = {
    "up": ("1 if the device is online.", lambda d: float(d.online)),
    "sample_rate_hertz": ("Sample rate of the last minute.", lambda d: d.clock.rate_hz),
    "silence_seconds": (
        "Time since the last bytes of the device.",
        lambda d: _seconds(d.silent_ns),
    ),
    "pending_samples": ("Samples without an outcome yet.", lambda d: d.samples.get("pending")),
    "clock_sd_seconds": (
        "Standard deviation of the last stamp.",
        lambda d: _seconds(d.clock.sigma_ns),
    ),
    "clock_bound_seconds": (
        "Limit of the constant error of stamps.",
        lambda d: _seconds(d.clock.bound_ns),
    ),
    "clock_jitter_seconds": (
        "Jitter of the arrivals.",
        lambda d: _seconds(d.clock.jitter_ns),
    ),
    "clock_skew_ratio": (
        "Relative rate error of the device clock, 1e-6 is 1 ppm.",
        lambda d: None if d.clock.skew_ppm is None else d.clock.skew_ppm * 1e-6,
    ),
}
"""Gauges of a device, by name without prefix. The value is None while it is unknown."""


def _process_start_s() -> float:
    """Return the UNIX time at which this process started, s.

    The boot time is not read from /proc/stat, because the systemd option ProcSubset hides this
    file.
    """
    fields = Path("/proc/self/stat").read_bytes().rpartition(b")")[2].split()
    since_boot_s = int(fields[_START_FIELD]) / os.sysconf("SC_CLK_TCK")
    return time.time_ns() * S_PER_NS - time.clock_gettime(time.CLOCK_BOOTTIME) + since_boot_s


def metric_families(rig: str, health: BridgeHealth, frames: FrameStatistics) -> Iterator[Metric]:
    """Yield the metrics of one instant.

    Parameters
    ----------
    rig
        Name of the rig, which becomes a label of ``jointfit_build_info``.
    health
        Counters of this instant.
    frames
        Latency histogram and date of the current calibration.
    """
    build = {"version": __version__, "rig": rig}
    yield InfoMetricFamily("jointfit_build", "Version of jointfitd and name of the rig.", build)
    yield from _frames(health, frames)
    for name, (help_text, read) in _COUNTERS.items():
        counter = CounterMetricFamily(f"jointfit_device_{name}", help_text, labels=["device"])
        _add(counter, health.core.devices, read)
        yield counter
    for name, (help_text, read) in _GAUGES.items():
        gauge = GaugeMetricFamily(f"jointfit_device_{name}", help_text, labels=["device"])
        _add(gauge, health.core.devices, read)
        yield gauge
    yield from _device_details(health.core.devices)
    yield from _calibration(health, frames)
    yield from _process(health)


def _add(
    family: GaugeMetricFamily | CounterMetricFamily,
    devices: Mapping[str, DeviceHealth],
    read: Callable[[DeviceHealth], float | None],
) -> None:
    for name, device in devices.items():
        if (value := read(device)) is not None:
            family.add_metric([name], value)


def _frames(health: BridgeHealth, frames: FrameStatistics) -> Iterator[Metric]:
    counts = health.core.frames
    for name, value, help_text in (
        ("frames", counts.sent, "Frames published."),
        ("empty_frames", counts.empty, "Frames without any sensor."),
        ("skipped_frames", counts.skipped, "Frames omitted after a stall of the process."),
    ):
        yield CounterMetricFamily(f"jointfit_{name}", help_text, value=value)
    limits = [*map(str, LATENCY_LIMITS_S), "+Inf"]
    yield HistogramMetricFamily(
        "jointfit_frame_latency_seconds",
        "Time from the arrival of the sample that completed a frame to its outputs.",
        buckets=list(zip(limits, accumulate(frames.counts), strict=True)),
        sum_value=frames.sum_ns * S_PER_NS,
    )


def _device_details(devices: Mapping[str, DeviceHealth]) -> Iterator[Metric]:
    """Yield the metric families of devices whose metrics have a second label."""
    samples = CounterMetricFamily(
        "jointfit_device_samples",
        "Samples by outcome: used, decimated, idle, late, duplicate, dropped.",
        labels=["device", "outcome"],
    )
    delay = GaugeMetricFamily(
        "jointfit_device_delay_seconds",
        "Quantiles of the delay from sampling to arrival in the last minute; 1 is the largest.",
        labels=["device", "share"],
    )
    clock = StateSetMetricFamily(
        "jointfit_device_clock_state", "State of the device clock.", labels=["device"]
    )
    sensor = StateSetMetricFamily(
        "jointfit_sensor_state", "State of an IMU in fusion.", labels=["device"]
    )
    for name, device in devices.items():
        for outcome, count in device.samples.items():
            if outcome != "pending":
                samples.add_metric([name, outcome], count)
        if (delays := device.clock.delays) is not None:
            for share, value_ns in (
                ("0.5", delays.p50_ns), ("0.99", delays.p99_ns), ("1", delays.max_ns),
            ):  # fmt: skip
                delay.add_metric([name, share], value_ns * S_PER_NS)
        clock.add_metric([name], {one: one == device.clock.state for one in _CLOCK_STATES})
        if device.sensor is not None:
            states = {one: one == device.sensor for one in get_args(SensorState)}
            sensor.add_metric([name], states)
    yield from (samples, delay, clock, sensor)


def _calibration(health: BridgeHealth, frames: FrameStatistics) -> Iterator[Metric]:
    phases = {str(phase): phase == health.core.phase for phase in CalibrationPhase}
    yield StateSetMetricFamily("jointfit_calibration_phase", "Phase of calibration.", value=phases)
    version = GaugeMetricFamily(
        "jointfit_calibration_version", "Version of the calibration in force."
    )
    if health.core.version is not None:
        version.add_metric([], health.core.version)
    yield version
    created = GaugeMetricFamily(
        "jointfit_calibration_created_timestamp_seconds",
        "UNIX time of the calibration in force; its age is time() minus this value.",
    )
    if health.core.version is not None and frames.calibrated_s is not None:
        created.add_metric([], frames.calibrated_s)
    yield created
    lag = GaugeMetricFamily(
        "jointfit_lag_seconds", "Lag in use of a sensor behind the cameras.", labels=["device"]
    )
    for name, found in health.core.lags.items():
        if found.used_ns is not None:
            lag.add_metric([name], found.used_ns * S_PER_NS)
    yield lag


def _process(health: BridgeHealth) -> Iterator[Metric]:
    link, process = health.link, health.process
    for name, value, help_text in (
        ("mqtt_connects", link.connects, "Connections to the broker."),
        ("mqtt_sent_messages", link.sent, "Messages sent."),
        ("mqtt_dropped_messages", link.dropped, "Messages dropped because the queue was full."),
        ("mqtt_ignored_requests", link.ignored_requests, "Requests ignored without an answer."),
    ):
        yield CounterMetricFamily(f"jointfit_{name}", help_text, value=value)
    delay_ms, fault = process.loop_delay_p99_ms, health.state
    recording = health.recording
    gauges: tuple[tuple[str, float | None, str], ...] = (
        ("jointfit_mqtt_connected", link.connected, "1 if the broker is connected."),
        ("jointfit_mqtt_queued_messages", link.queued, "Messages waiting for the broker."),
        (
            "jointfit_event_loop_delay_p99_seconds",
            None if delay_ms is None else delay_ms * 1e-3,
            "0.99 quantile of the delay of the event loop in the last minute.",
        ),
        (
            "jointfit_storage_fault",
            fault.fault is not None or fault.not_stored is not None,
            "1 if the state directory or the calibration cannot be written.",
        ),
        (
            "jointfit_recording_backlog_bytes",
            None if recording is None or not recording.active else recording.backlog_bytes,
            "Recorded data not yet written.",
        ),
        ("process_resident_memory_bytes", _resident_bytes(), "Resident memory."),
        (
            "process_start_time_seconds",
            _process_start_s(),
            "UNIX time of the start of the process.",
        ),
    )
    for name, found, help_text in gauges:
        gauge = GaugeMetricFamily(name, help_text)
        if found is not None:
            gauge.add_metric([], float(found))
        yield gauge
    cpu_s = time.process_time()
    yield CounterMetricFamily("process_cpu_seconds", "Processor time.", value=cpu_s)


def _resident_bytes() -> int | None:
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return None
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def _seconds(value_ns: float | None) -> float | None:
    return None if value_ns is None or value_ns == float("inf") else value_ns * S_PER_NS
