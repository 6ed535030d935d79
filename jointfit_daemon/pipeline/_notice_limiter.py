"""Turns what wires and clocks do into notices, at most one a minute for each kind and device.

Invariant: nothing is lost by the limit. A condition is reported when it begins, with its sums once
a minute while it lasts, and when a minute has passed without it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Literal

from jointfit_daemon.model import Corrupt, DeviceEvent
from jointfit_daemon.pipeline.events import Notice

if TYPE_CHECKING:
    from collections.abc import Mapping

QUIET_NS = 60_000_000_000
"""Least time between two notices of a kind and device, ns: health counts every single one."""

_NS_PER_S = 1_000_000_000

STEP_NS = 2_000_000
"""UNIX time set by less is followed and not told of."""

Level = Literal["info", "warning", "error"]
_LEVELS: dict[str, Level] = {
    "warning": "warning",
    "error": "error",
}
_JUMPS = {"restart": "clock", "clock": "clock", "counter": "wire"}
"""Kind of the notice for each device event that is reported by its last text and its number."""


@dataclass(slots=True)
class _Held:
    told_ns: int
    count: int = 0
    amount: int = 0
    lasting: bool = False
    """Whether it was reported more than once, so that its end is worth a notice."""
    text: str = ""
    data: Mapping[str, object] = field(default_factory=dict)


@dataclass(slots=True)
class Bulletin:
    """Collects corruption, gaps, jumps of clocks; passes on everything else at once."""

    _held: dict[tuple[str, str], _Held] = field(default_factory=dict)

    def add(self, now_ns: int, source: str, item: Corrupt | DeviceEvent) -> list[Notice]:
        """Take one happening; return what may be told already."""
        if isinstance(item, Corrupt):
            return self._hold(now_ns, (source, "corrupt"), item.discarded, item.reason)
        if item.kind == "gap":
            lost = item.data.get("lost", 1)
            return self._hold(
                now_ns, (source, "gap"), lost if isinstance(lost, int) else 1, item.text
            )
        if item.kind in _JUMPS:
            return self._hold(now_ns, (source, item.kind), 1, item.text, item.data)
        level: Level = _LEVELS.get(item.kind, "info")
        return [Notice(now_ns, "device", source, item.text, level, dict(item.data))]

    def due(self, now_ns: int) -> list[Notice]:
        """Return the held-back notices whose quiet time is over."""
        if not self._held:
            return []
        notices = []
        for key, held in self._held.items():
            if now_ns - held.told_ns < QUIET_NS:
                continue
            if held.count:
                held.lasting = key[1] not in _JUMPS
                notices.append(_notice(now_ns, key, held))
            elif held.lasting:
                notices.append(_ended(now_ns, key, held))
        return notices

    def _hold(
        self,
        now_ns: int,
        key: tuple[str, str],
        amount: int,
        text: str,
        data: Mapping[str, object] = MappingProxyType({}),
    ) -> list[Notice]:
        held = self._held.setdefault(key, _Held(told_ns=now_ns - QUIET_NS))
        held.count += 1
        held.amount += amount
        held.text, held.data = text, data
        if now_ns - held.told_ns < QUIET_NS:
            return []
        held.lasting = False
        return [_notice(now_ns, key, held)]


def _notice(now_ns: int, key: tuple[str, str], held: _Held) -> Notice:
    source, kind = key
    if kind in _JUMPS:
        return _jump(now_ns, key, held)
    if kind == "gap":
        text = f"{held.amount} sample{'s' if held.amount > 1 else ''} lost on the way"
    else:
        text = f"{held.amount} bytes made no message: {held.text}"
    if held.lasting:
        text = f"{text}, in the last {(now_ns - held.told_ns) / _NS_PER_S:.0f} s"
    data = _sums(kind, held)
    held.told_ns, held.count, held.amount = now_ns, 0, 0
    return Notice(now_ns, "wire", source, text, "warning", data)


def _ended(now_ns: int, key: tuple[str, str], held: _Held) -> Notice:
    """Return that nothing of a kind happened since the last notice."""
    source, kind = key
    what = "no sample was lost" if kind == "gap" else "all bytes made messages"
    passed_s = (now_ns - held.told_ns) / _NS_PER_S
    held.told_ns, held.lasting = now_ns, False
    return Notice(now_ns, "wire", source, f"{what} for {passed_s:.0f} s", "info", _sums(kind, held))


def _sums(kind: str, held: _Held) -> dict[str, object]:
    if kind == "gap":
        return {"gaps": held.count, "lost": held.amount}
    return {"runs": held.count, "discarded_bytes": held.amount}


def _jump(now_ns: int, key: tuple[str, str], held: _Held) -> Notice:
    """Return the last of what was held back, and how often there was something of its kind."""
    source, kind = key
    text, data = held.text, dict(held.data)
    if held.count > 1:
        text = f"{text} (the last of {held.count} such events)"
        data["events"] = held.count
    held.told_ns, held.count, held.amount = now_ns, 0, 0
    return Notice(now_ns, _JUMPS[kind], source, text, "warning", data)


def unix_time_set(now_ns: int, step_ns: int) -> list[Notice]:
    """Return what to tell when UNIX time of this host was set forward by `step_ns`."""
    if abs(step_ns) < STEP_NS:
        return []
    step_s = step_ns / 1e9
    text = f"UNIX time was set back by {-step_s:.3f} s"
    if step_s > 0:  # in suspend CLOCK_MONOTONIC stands still
        text = f"UNIX time was set forward by {step_s:.3f} s, or the host slept so long"
    return [Notice(now_ns, "clock", "host", text, "warning", {"step_s": step_s})]
