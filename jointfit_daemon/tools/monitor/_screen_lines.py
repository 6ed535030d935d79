"""The whole screen as text lines: header, tabs, banner, the chosen view, notice, and keys.

Invariants: `screen_lines` uses no clock, I/O or terminal, and changes only the scroll position of
the state. The number and the width of its lines equal those of the terminal.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.pipeline.events import NoticeLevel
from jointfit_daemon.tools.monitor._calibration_lines import calibration_lines, history_lines
from jointfit_daemon.tools.monitor._device_lines import health_lines
from jointfit_daemon.tools.monitor._live_lines import STALE_S, live_lines, pose_age_s
from jointfit_daemon.tools.monitor._monitor_state import VIEWS
from jointfit_daemon.tools.monitor._recording_words import recording_mark, recording_of
from jointfit_daemon.tools.monitor._text_lines import Line, wrap
from jointfit_daemon.tools.monitor._words import (
    SYMBOLS,
    calibration_sentence,
    format_clock,
    format_duration,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.tools.monitor._monitor_state import MonitorState
    from jointfit_daemon.tools.monitor._rig_view import Moment
    from jointfit_daemon.tools.monitor._text_lines import Style
    from jointfit_daemon.tools.monitor._words import Level

_WIDE = 60
"""Smallest width at which the header is one line, cells."""
_LOSS_LINES = 3
"""Maximum number of lines of a banner or a notice."""
_CLOCK_ERROR_S = 5.0
"""Threshold of the difference between the clocks of gateway and this machine, s. A larger
difference is displayed."""
_TITLES = {
    "live": "Live", "calibrate": "Calibrate", "history": "History", "health": "Health",
    "log": "Log",
}  # fmt: skip
_SHORT = {"live": "Live", "calibrate": "Cal", "history": "Hist", "health": "Health", "log": "Log"}
_EVENT_LEVELS: dict[NoticeLevel, Level] = {
    NoticeLevel.INFO: "muted",
    NoticeLevel.WARNING: "warning",
    NoticeLevel.ERROR: "error",
}
_STOPPED = (
    "jointfitd stopped or lost its broker. The monitor continues when jointfitd is back. Check it"
    " with: systemctl status jointfitd"
)


def screen_lines(state: MonitorState, width: int, height: int, now: Moment) -> list[Line]:
    """Return the lines of the screen; limit the scroll position of `state` to the view's length."""
    level, words, loss = page_state(state, now)
    top = _header(state, level, words, width, now)
    if state.base is not None:
        titles = _TITLES if width >= _WIDE else _SHORT
        gap = "   " if width >= _WIDE else ""
        line = Line()
        for number, name in enumerate(VIEWS, 1):
            chosen = name == state.view
            text = f"[{number} {titles[name]}]" if chosen else f" {number} {titles[name]} "
            style: Style = "chosen" if chosen else "muted"
            line = line.add(gap if line.spans else "").add(text, style)
        if width >= _WIDE:
            line = _justify(line, Line.of(*recording_mark(state.rig, now)), width)
        top.append(line)
    top += wrap(f"✖ {loss}" if loss else "", width, "error")[:_LOSS_LINES]

    # Show the keys of the view in one line or two.
    rows, row = [], Line()
    for key, words in _keys(state):
        item = Line.of(key, "strong").add(f" {words}", "muted")
        if row.spans and row.width + 2 + item.width > width:
            rows.append(row)
            row = Line()
        row = row.add("  ") + item if row.spans else item
    bottom = [*_notice(state, width, now), *rows, row]

    free = max(0, height - len(top) - len(bottom))
    body = _body(state, width, free, now)
    state.scroll = max(0, min(state.scroll, len(body) - free))
    shown = body[state.scroll : state.scroll + free]
    if shown and len(body) > state.scroll + free:
        more = len(body) - state.scroll - free + 1
        shown[-1] = Line.of(f"↓ {more} more lines: key ↓", "muted")
    shown += [Line()] * (free - len(shown))
    lines = [*top, *shown, *bottom][:height]
    if state.unicode:
        return [line.fit(width) for line in lines]

    # In ASCII, a full stop replaces the ellipsis of a cropped line.
    fitted = [line.to_ascii().fit(width) for line in lines]
    return [
        Line(tuple((text.replace("…", "."), style) for text, style in line.spans))
        for line in fitted
    ]


def page_state(state: MonitorState, now: Moment) -> tuple[Level, str, str]:
    """Return level and text of the overall state, and the fault for the banner or an empty text."""
    rig = state.rig
    if state.link == "lost":
        return "error", "Broker lost", f"{state.reason}. Trying again."
    if state.link == "connecting":
        return "muted", "Connecting to the broker", ""
    if state.base is None:
        return "muted", "Choose a rig" if state.rigs else "Looking for rigs on the broker", ""
    if rig.bridge == "offline":
        return "error", "jointfitd is not running", _STOPPED

    fault = next(iter(rig.faults.values()), "")
    if rig.bridge != "online":
        words = "The messages of jointfitd cannot be read" if fault else "Waiting for jointfitd"
        return "error" if fault else "muted", words, fault

    calibration = rig.calibration
    age_s = pose_age_s(rig, now)
    if age_s is not None and age_s > 2 * STALE_S and not fault:
        fault = (
            f"No pose for {format_duration(age_s)}: jointfitd does not answer, or the network"
            " drops its messages"
        )

    poor = calibration is not None and (calibration.phase == "aborted" or calibration.kept)
    level: Level = "error" if fault else "warning" if poor else "good"
    if calibration is None or calibration.phase == "uncalibrated" or state.is_running:
        level = "error" if fault else "muted"
    return level, calibration_sentence(calibration, rig.gateway_us(now)), fault


def _header(state: MonitorState, level: Level, words: str, width: int, now: Moment) -> list[Line]:
    """Return the header: rig and state on the left, broker and gateway clock on the right."""
    rig = state.rig
    name = rig.info.rig if rig.info is not None else (state.base or "jointfit monitor")
    style: Style = "" if level in ("good", "muted") else level
    words = f"{SYMBOLS[level]} {words}"

    clock = format_clock(rig.gateway_us(now), state.timezone)
    error_s = rig.clock_error_us / 1e6
    if abs(error_s) > _CLOCK_ERROR_S:
        direction = "ahead" if error_s > 0 else "behind"
        clock += f" ({format_duration(abs(error_s))} {direction})"

    if width < _WIDE:
        recording, recording_style = recording_mark(rig, now)
        shown = f"{recording}  " if recording else ""
        side = Line.of(shown, recording_style).add(clock, "muted")
        first = _justify(Line.of(name, "strong"), side, width)
        return [first, *wrap(words, width, style)[:2]]
    right = Line.of(f"{state.broker}  {clock}", "muted")
    return [_justify(Line.of(f"{name}  ", "strong").add(words, style), right, width)]


def _justify(left: Line, right: Line, width: int) -> Line:
    """Return a line with a left and a right part; the left part is cropped if necessary."""
    free = width - right.width - 1
    return left.fit(free).add(" ") + right if free > 0 else left.fit(width)


def _body(state: MonitorState, width: int, height: int, now: Moment) -> list[Line]:
    if state.base is None:
        if state.link != "searching":
            return []
        if not state.rigs:
            return _waiting_lines(state, width)
        lines = [Line.of("Several rigs use this broker:", "strong")]
        for at, (base, name) in enumerate(state.rigs.items()):
            chosen = at == min(state.cursor, len(state.rigs) - 1)
            style: Style = "chosen" if chosen else ""
            lines.append(Line.of(f"{'▶' if chosen else ' '} {name}  ({base})", style))
        return lines

    rig = state.rig
    if rig.bridge == "unknown" and rig.pose is None:
        return [] if rig.faults else _waiting_lines(state, width)
    views: dict[str, Callable[[], list[Line]]] = {
        "live": lambda: live_lines(state, width, height, now),
        "calibrate": lambda: calibration_lines(rig, width),
        "history": lambda: history_lines(state, width),
        "health": lambda: health_lines(rig, width, now, state.broker),
        "log": lambda: _log_lines(state, width),
    }
    return views[state.view]()


def _waiting_lines(state: MonitorState, width: int) -> list[Line]:
    """Return the instructions for starting a daemon, which appear while the broker has no rig."""
    if state.link not in ("searching", "connected"):
        return []
    base = "" if state.base is None else f" below {state.base}"
    return [
        Line(),
        *wrap(f"Waiting for jointfitd on {state.broker}", width, "strong"),
        *wrap(
            f"The broker answers, but no rig publishes on it{base}. Start the daemon with the"
            " configuration of the rig:",
            width,
        ),
        Line.of("  jointfitd --config rig.toml", "imu"),
        *wrap(
            "If the daemon runs: host and port under [mqtt] of its rig.toml must be those of this"
            " broker, and this account must have the right to read the topics of the rig.",
            width,
            "muted",
        ),
    ]


def _log_lines(state: MonitorState, width: int) -> list[Line]:
    """Return the events, the newest first."""
    events = [
        event for event in state.rig.events if not state.only_problems or event.level != "info"
    ]
    if not events:
        words = "warning or error" if state.only_problems else "event"
        return wrap(f"No {words} since the monitor was started.", width, "muted")

    lines = []
    for event in events:
        level = _EVENT_LEVELS[event.level]
        clock = format_clock(event.t_us, state.timezone)
        style: Style = "" if level == "muted" else level
        text = f"{clock} {SYMBOLS[level]} {event.id}: {event.text}"
        lines += wrap(text, width, style, indent=2)
    return lines


def _notice(state: MonitorState, width: int, now: Moment) -> list[Line]:
    notice = state.notice
    if notice is None or now.monotonic_s > notice.until_s:
        return []
    mark = "✖ " if notice.refused else "✔ "
    style: Style = "error" if notice.refused else "good"
    return wrap(mark + notice.text, width, style, indent=2)[:_LOSS_LINES]


def _keys(state: MonitorState) -> list[tuple[str, str]]:
    """Return the keys that currently have an effect, each with a description."""
    if state.base is None:
        choose = [("↑↓", "select"), ("Enter", "show")] if len(state.rigs) > 1 else []
        return [*choose, ("q", "quit")]

    # The effect of a key depends on whether a calibration phase runs.
    keys = {
        "live": [("j", "next angle"), ("←→", "turn")],
        "calibrate": [] if state.is_running else [("a", "align"), ("f", "move")],
        "history": [("↑↓", "select"), ("Enter", "use"), ("r", "revert")],
        "health": [("↑↓", "scroll")],
        "log": [("↑↓", "scroll"), ("w", "all" if state.only_problems else "warnings only")],
    }[state.view]
    if state.asked_to_stop:
        return [("R", "stop the recording"), ("any other key", "continue it")]
    phase = ("x", "stop phase") if state.is_running else ("s", "static pose")
    recording = recording_of(state.rig)
    record = [] if recording is None else [("R", "stop rec" if recording.active else "record")]
    return [("1–5", "views"), *keys, phase, *record, ("m", "mark"), ("q", "quit")]
