"""Rate limit for notices about data connections and clocks: one per minute, device and kind.

A condition, such as the loss of samples, is reported when it begins. While the condition lasts, its
totals are reported once a minute. If lost samples or corrupt bytes were reported more than once,
their end is reported after a minute without them. A notice of lost samples is a warning only if
they exceed the share `MOST_LOST` of the samples in a minute. Notices of corrupt bytes and of clock
events are always warnings.

Invariant: the sum of the totals in all notices equals the total number of events.
"""

from __future__ import annotations

from collections.abc import Mapping  # noqa: TC003 - mypyc evaluates the types of fields
from dataclasses import dataclass, field
from types import MappingProxyType

from jointfit_daemon.model import Corrupt, DeviceEvent
from jointfit_daemon.pipeline.events import Notice, NoticeKind, NoticeLevel
from jointfit_daemon.pipeline.health import MOST_LOST
from jointfit_daemon.units import NS_PER_S

QUIET_NS = 60_000_000_000
"""Shortest time between two notices of the same device and kind, ns. The counts in
``bridge/health`` include all events."""


STEP_NS = 2_000_000
"""Smallest step of UNIX time that is reported, ns. The corrections by NTP are smaller."""

_LEVELS = {"warning": NoticeLevel.WARNING, "error": NoticeLevel.ERROR}
"""Level of the notice by kind of device event. All other kinds have the level ``info``."""
_JUMPS = {"restart": NoticeKind.CLOCK, "clock": NoticeKind.CLOCK, "counter": NoticeKind.WIRE}
"""Kind of the notice for device events that are summarized by their last text and their number."""
_NO_DATA: Mapping[str, object] = MappingProxyType({})


@dataclass(slots=True)
class _Condition:
    reported_ns: int
    rate_hz: float
    """Sample rate of the device, Hz."""
    count: int = 0
    amount: int = 0
    """Number of lost samples or discarded bytes."""
    lasting: bool = False
    """Whether lost samples or corrupt bytes were reported more than once. In this case their end is
    reported as well."""
    text: str = ""
    data: Mapping[str, object] = field(default_factory=dict)


@dataclass(slots=True)
class NoticeLimiter:
    """Collects corrupt bytes, gaps and clock jumps, and passes on all other events at once."""

    _conditions: dict[tuple[str, str], _Condition] = field(default_factory=dict)

    def add(
        self, now_ns: int, source: str, item: Corrupt | DeviceEvent, rate_hz: float
    ) -> list[Notice]:
        """Add an event of a source with the sample rate `rate_hz`; return the due notices."""
        if isinstance(item, Corrupt):
            kind, amount, text, data = "corrupt", item.discarded, item.reason, _NO_DATA
        elif item.kind == "gap":
            lost = item.data.get("lost", 1)
            kind, text, data = "gap", item.text, _NO_DATA
            amount = lost if isinstance(lost, int) else 1
        elif item.kind in _JUMPS:
            kind, amount, text, data = item.kind, 1, item.text, item.data
        else:
            level = _LEVELS.get(item.kind, NoticeLevel.INFO)
            return [Notice(now_ns, NoticeKind.DEVICE, source, item.text, level, dict(item.data))]

        key = source, kind
        condition = self._conditions.setdefault(key, _Condition(now_ns - QUIET_NS, rate_hz))
        condition.count += 1
        condition.amount += amount
        condition.text, condition.data, condition.rate_hz = text, data, rate_hz
        if now_ns - condition.reported_ns < QUIET_NS:
            return []
        condition.lasting = False
        return [_notice(now_ns, key, condition)]

    def due(self, now_ns: int) -> list[Notice]:
        """Return the collected notices whose waiting time has ended."""
        notices = []
        for key, condition in self._conditions.items():
            if now_ns - condition.reported_ns < QUIET_NS:
                continue

            source, kind = key
            if condition.count:
                condition.lasting = kind not in _JUMPS
                notices.append(_notice(now_ns, key, condition))
            elif condition.lasting:
                what = "no samples lost" if kind == "gap" else "no bytes discarded"
                text = f"{what} for {(now_ns - condition.reported_ns) / NS_PER_S:.0f} s"
                data = _totals(kind, condition)
                notices.append(
                    Notice(now_ns, NoticeKind.WIRE, source, text, NoticeLevel.INFO, data)
                )
                condition.reported_ns, condition.lasting = now_ns, False
        return notices


def _notice(now_ns: int, key: tuple[str, str], condition: _Condition) -> Notice:
    """Return the notice of a condition, and start the waiting time until its next notice."""
    source, kind = key
    level, elapsed_s = NoticeLevel.WARNING, (now_ns - condition.reported_ns) / NS_PER_S
    if kind in _JUMPS:
        text, data = condition.text, dict(condition.data)
        if condition.count > 1:
            text = f"{text} (last of {condition.count} such events)"
            data["events"] = condition.count
    else:
        text = f"{condition.amount} bytes discarded: {condition.text}"
        if kind == "gap":
            text = f"{condition.amount} sample{'s' if condition.amount > 1 else ''} lost"
        if condition.lasting:
            text = f"{text}, in the last {elapsed_s:.0f} s"
        if kind == "gap":
            # There is no interval before the first notice, so lost samples are compared with one
            # minute of data.
            interval_s = elapsed_s if condition.lasting else QUIET_NS / NS_PER_S
            share = condition.amount / (condition.rate_hz * interval_s)
            text = f"{text} ({100 * share:.2f} %)" if condition.lasting else text
            level = NoticeLevel.WARNING if share > MOST_LOST else NoticeLevel.INFO
        data = _totals(kind, condition)

    condition.reported_ns, condition.count, condition.amount = now_ns, 0, 0
    reported = _JUMPS.get(kind, NoticeKind.WIRE)
    return Notice(now_ns, reported, source, text, level, data)


def _totals(kind: str, condition: _Condition) -> dict[str, object]:
    if kind == "gap":
        return {"gaps": condition.count, "lost": condition.amount}
    return {"runs": condition.count, "discarded_bytes": condition.amount}


def unix_step_notices(now_ns: int, step_ns: int) -> list[Notice]:
    """Return a notice that UNIX time of this host changed by `step_ns`; none for a small step."""
    if abs(step_ns) < STEP_NS:
        return []
    step_s = step_ns / 1e9
    text = f"UNIX time of this host was set back by {-step_s:.3f} s"
    if step_s > 0:  # CLOCK_MONOTONIC stops while the host is suspended
        text = f"UNIX time was set forward by {step_s:.3f} s, or the host was suspended that long"
    return [Notice(now_ns, NoticeKind.CLOCK, "host", text, NoticeLevel.WARNING, {"step_s": step_s})]
