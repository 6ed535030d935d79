"""Devices of a rig as text: the table of the live view, and the health table."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.cells import cell_len

from jointfit_daemon.tools.monitor._recording_words import recording_text
from jointfit_daemon.tools.monitor._text_lines import Column, Line, fit_text, table, wrap
from jointfit_daemon.tools.monitor._words import (
    SYMBOLS,
    UNKNOWN,
    clock_quality,
    format_duration,
    format_number,
)

if TYPE_CHECKING:
    from jointfit_daemon.outputs.payload_models import DeviceCounts, Health, Latency
    from jointfit_daemon.tools.monitor._rig_view import Moment, RigView
    from jointfit_daemon.tools.monitor._text_lines import Style
    from jointfit_daemon.tools.monitor._words import Level

_RATE_SHARE = 0.95
"""Share of the output rate below which the rate of an IMU is reported as slow."""
_WIDE = 72
"""Smallest width at which the table has all columns, cells."""
_LONGEST_NAME = 14
"""Maximum width of a device name in the table, cells."""
_NAME = 12
"""Maximum width of a device name in a narrow terminal, cells."""


@dataclass(frozen=True, slots=True)
class DeviceSummary:
    """Texts about one device, and the severity level of its state."""

    name: str
    place: str
    level: Level
    state: str
    rate: str
    loss: str
    clock_level: Level
    clock: str
    event: str


def summaries(rig: RigView, now: Moment) -> list[DeviceSummary]:
    """Return a summary of each device, in the order of the rig."""
    names = [] if rig.info is None else [*rig.info.devices]
    return [_summary(rig, name, now) for name in names]


def _summary(rig: RigView, name: str, now: Moment) -> DeviceSummary:
    device = None if rig.info is None else rig.info.devices.get(name)
    counts = None if rig.health is None else rig.health.devices.get(name)
    online = rig.availability.get(name) == "online" and rig.bridge == "online"

    # Determine level and state. The level ``error`` means that the user must act.
    availability = rig.availability.get(name, "unknown")
    flags = [] if rig.pose is None else rig.pose.flags
    sensor = None if counts is None else counts.sensor
    silent = availability == "offline" or (availability == "online" and sensor == "lost")
    stuck = f"stuck:{name}" in flags or sensor == "stuck"
    cases: tuple[tuple[bool, Level, str], ...] = (
        (rig.bridge == "offline", "muted", "jointfitd is not running"),
        (silent, "error", "No data: check cable, power"),
        (availability != "online", "muted", "Waiting"),
        (stuck, "error", "Stuck, repeats its value: restart it"),
        (f"slipped:{name}" in flags, "error", "Slipped on the body: fasten it"),
        (_is_slow(rig, name, counts), "warning", "Slower than the output rate"),
    )
    level, state = next(
        ((level, words) for applies, level, words in cases if applies), ("good", "Works")
    )

    clock_level, clock = clock_quality(counts) if online else ("muted", UNKNOWN)
    is_camera = device is not None and device.kind == "mocap"
    place = "cameras" if is_camera else (device.segment if device is not None else None)
    loss = None
    if counts is not None:
        loss = 100.0 * counts.lost / max(1, counts.received + counts.lost)
    return DeviceSummary(
        name,
        place or UNKNOWN,
        level,
        state,
        format_number(counts.rate_hz if counts is not None and online else None, 1, " Hz"),
        format_number(loss, 2, " %"),
        clock_level,
        clock,
        _event(rig, name, now),
    )


def _is_slow(rig: RigView, name: str, counts: DeviceCounts | None) -> bool:
    if rig.info is None or rig.info.devices[name].kind != "imu":
        return False
    if counts is None or counts.rate_hz is None:
        return False
    return counts.rate_hz < _RATE_SHARE * rig.info.output_rate_hz


def _event(rig: RigView, name: str, now: Moment) -> str:
    event = rig.last_events.get(name)
    if event is None:
        return ""
    gateway_us = rig.gateway_us(now)
    age = "" if gateway_us is None else f"{format_duration((gateway_us - event.t_us) / 1e6)} ago: "
    return f"{age}{event.text}"


def mark_level(level: Level, text: str) -> tuple[str, Style]:
    """Return a text with the symbol and the style of its level; ``good`` has no colour."""
    style: Style = "" if level == "good" else level
    return f"{SYMBOLS[level]} {text}", style


def device_lines(rig: RigView, width: int, now: Moment) -> list[Line]:
    """Return the device table of the live view: one line per device, more in a narrow terminal."""
    devices = summaries(rig, now)
    if not devices:
        return []
    if width < _WIDE:
        return [line for device in devices for line in _narrow(device, width)]
    columns = [
        Column("sensor"), Column("segment"), Column("rate", right=True),
        Column("loss", right=True), Column("clock"), Column("state and last event"),
    ]  # fmt: skip
    rows: list[list[tuple[str, Style]]] = []
    for device in devices:
        text, style = mark_level(device.level, device.state)
        event = f" · {device.event}" if device.event else ""
        clock_style: Style = "warning" if device.clock_level == "warning" else ""
        rows.append(
            [
                (fit_text(device.name, min(_LONGEST_NAME, cell_len(device.name))), "strong"),
                (device.place, ""), (device.rate, ""), (device.loss, ""),
                (device.clock, clock_style), (text + event, style),
            ]
        )  # fmt: skip
    return table(columns, rows, width)


def _narrow(device: DeviceSummary, width: int) -> list[Line]:
    name = f"{device.name} {device.place}"
    text, style = mark_level(device.level, device.state)
    head = Line.of(fit_text(name, min(_NAME + 2, width // 3)), "strong")
    rate = f" {fit_text(device.rate, 9, right=True)} " if device.rate != UNKNOWN else " "
    line = head.add(rate).add(text, style)
    if line.width <= width:
        return [line]
    return [head.add(rate), *wrap(text, width, style, indent=2)]


def health_lines(rig: RigView, width: int, now: Moment, broker: str) -> list[Line]:
    """Return counters, delays and clocks of every device, and the state of the daemon."""
    health = rig.health
    if health is None:
        return wrap("Waiting for bridge/health: the daemon sends it every 10 s.", width, "muted")
    lines = [line for name in health.devices for line in _counters(rig, name, width, now)]
    lines += [Line(), Line.of("Daemon", "strong"), *_daemon(rig, health, width, broker, now)]
    return lines


def _counters(rig: RigView, name: str, width: int, now: Moment) -> list[Line]:
    device, counts = _summary(rig, name, now), rig.health.devices[name] if rig.health else None
    if counts is None:
        return []
    text, style = mark_level(device.level, device.state)
    delay = counts.delay_us
    late_ms = "" if delay is None else (
        f", delay {format_number(_ms(delay.p50), 1)} ms median, {format_number(_ms(delay.p99), 1)}"
        " ms p99"
    )  # fmt: skip
    facts = (
        f"{counts.received} received, {counts.used} used, {counts.late} late, {counts.lost} lost,"
        f" {counts.dropped} dropped, {counts.corrupt} corrupt, {counts.duplicate} duplicate;"
        f" {counts.restarts} restarts, {counts.reconnects} reconnects"
    )
    clock = f"{device.rate}, loss {device.loss}, clock {device.clock}{late_ms}"
    head = Line.of(f"{name} ", "strong").add(f"{device.place}  ", "muted").add(text, style)
    body = [
        *wrap(clock, width - 2),
        *wrap(facts, width - 2, "muted"),
        *wrap(device.event, width - 2, "muted"),
    ]
    indented = [Line.of("  ") + line for line in body]
    return [head.fit(width) if head.width > width else head, *indented]


def _ms(microseconds: float | None) -> float | None:
    return None if microseconds is None else microseconds / 1000.0


def _latency_text(latency: Latency) -> str:
    """Return the latency of frames as text: of all stages together, and the p99 of each stage."""
    total = latency.total_us
    if total is None:
        return "frames: none written since the last health message"
    stages = {
        "decoded": latency.decoded_us, "aligned": latency.aligned_us, "fused": latency.fused_us,
        "encoded": latency.encoded_us, "written": latency.written_us,
    }  # fmt: skip
    parts = ", ".join(
        f"{name} {format_number(None if stage is None else _ms(stage.p99), 2)}"
        for name, stage in stages.items()
    )
    return (
        f"frames: {format_number(_ms(total.p50), 1, ' ms')} from arrival to broker (median), "
        f"{format_number(_ms(total.p99), 1, ' ms')} (p99), "
        f"{format_number(_ms(total.max), 1, ' ms')} at most; p99 by stage, ms: {parts}"
    )


def _daemon(rig: RigView, health: Health, width: int, broker: str, now: Moment) -> list[Line]:
    """Return the state of the daemon: process, link, learning and recording."""
    process, link, frames = health.process, health.link, health.frames
    memory_mb = None if process.rss_bytes is None else process.rss_bytes / 1e6
    learning = str(health.learning.state)
    if health.learning.reason:
        learning = f"{learning}: {health.learning.reason}"
    texts: list[tuple[str, Style]] = [
        (f"{format_number(process.cpu_pct, 1, ' %')} of a core, "
         f"{format_number(memory_mb, 0, ' MB')}, "
         f"event loop {format_number(process.loop_delay_p99_ms, 1, ' ms')} late (p99)", ""),
        (f"{frames.sent} frames sent, {frames.empty} without sensors, "
         f"{frames.skipped} skipped", ""),
        (f"broker {broker}: {link.sent} messages sent, {link.dropped} dropped, "
         f"{link.ignored_requests} requests ignored", ""),
        (f"online learning: {learning}", ""),
    ]  # fmt: skip
    if health.latency is not None:
        texts.append((_latency_text(health.latency), ""))
    if link.denied:
        denied = ", ".join(link.denied)
        texts.append((f"▲ the broker refuses {denied}: correct its access list", "warning"))
    faults = (health.state.fault, health.state.not_stored)
    texts += [(f"✖ {fault}", "error") for fault in faults if fault]
    if health.recording is not None:
        texts.append(recording_text(rig, now))
    if rig.info is not None:
        texts.append((f"jointfitd {rig.info.software}, rig {rig.info.rig}", "muted"))
    return [line for text, style in texts for line in wrap(text, width, style, indent=2)]
