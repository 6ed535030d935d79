"""State of the recording as text, for the header and for the health view."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jointfit_daemon.outputs.payload_models import RecordingState
    from jointfit_daemon.tools.monitor._rig_view import Moment, RigView
    from jointfit_daemon.tools.monitor._text_lines import Style

_GB = 1e9


def recording_of(rig: RigView) -> RecordingState | None:
    """Return the state of the recording; None if the state is unknown."""
    return None if rig.health is None or rig.bridge != "online" else rig.health.recording


def recording_mark(rig: RigView, now: Moment) -> tuple[str, Style]:
    """Return the text for the header, at most 18 cells; empty if the state is unknown."""
    recording = recording_of(rig)
    if recording is None:
        return "", ""
    if not recording.active:
        return "○ not recording", "muted"
    if recording.failure:
        return "✖ rec interrupted", "error"
    return f"● rec {_stopwatch(_duration_s(rig, recording, now))}", "strong"


def recording_text(rig: RigView, now: Moment) -> tuple[str, Style]:
    """Return the text for the health view, with file, size, losses and free space."""
    recording = recording_of(rig)
    if recording is None:
        return "", ""
    free = "" if recording.free_bytes is None else f"; {format_bytes(recording.free_bytes)} free"
    lost = f", {recording.lost} messages lost" if recording.lost else ""
    facts = (
        f"{recording.file}, {_stopwatch(_duration_s(rig, recording, now))},"
        f" {format_bytes(recording.written_bytes)}{lost}"
    )
    if recording.active and recording.failure:
        return f"✖ recording interrupted: {recording.failure}: {facts}{free}", "error"
    if recording.active:
        return f"recording {facts}{free}", "warning" if lost else ""
    return f"not recording{f'; last file {facts}' if recording.file else ''}{free}", ""


def format_bytes(count: float) -> str:
    """Return a size in MB or GB."""
    return f"{count / _GB:.1f} GB" if count >= _GB else f"{count / 1e6:.1f} MB"


def _duration_s(rig: RigView, recording: RecordingState, now: Moment) -> float:
    """Return the duration of the recording, including the time since the last health message."""
    gateway_us = rig.gateway_us(now)
    if not recording.active or gateway_us is None or rig.health is None:
        return recording.duration_s
    return recording.duration_s + max(0.0, (gateway_us - rig.health.t_us) / 1e6)


def _stopwatch(seconds: float) -> str:
    """Return a duration in hours, minutes and seconds, such as ``0:12:04``."""
    minutes, whole_s = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{whole_s:02}"
