"""Turns what wires do into notices, at most one in ten seconds for each kind and device.

Law: nothing is lost by the limit: what is held back is summed into the next notice.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from jointfit_daemon.model import Corrupt, DeviceEvent
from jointfit_daemon.pipeline.events import Notice

QUIET_NS = 10_000_000_000
"""Every drop-out is counted in health; a line each ten seconds and kind is enough for a log."""

Level = Literal["info", "warning", "error"]
_LEVELS: dict[str, Level] = {
    "warning": "warning",
    "error": "error",
    "restart": "warning",
    "clock": "warning",
}


@dataclass(slots=True)
class _Held:
    told_ns: int
    count: int = 0
    amount: int = 0
    text: str = ""


@dataclass(slots=True)
class Bulletin:
    """Collects corruption and gaps; passes everything else on at once."""

    _held: dict[tuple[str, str], _Held] = field(default_factory=dict)

    def add(self, now_ns: int, source: str, item: Corrupt | DeviceEvent) -> list[Notice]:
        """Take one happening; return what may be told already."""
        if isinstance(item, Corrupt):
            return self._hold(now_ns, source, "corrupt", item.discarded, item.reason)
        if item.kind == "gap":
            lost = item.data.get("lost", 1)
            return self._hold(
                now_ns, source, "gap", lost if isinstance(lost, int) else 1, item.text
            )
        kind = "clock" if item.kind in {"restart", "clock"} else "device"
        level: Level = _LEVELS.get(item.kind, "info")
        return [Notice(now_ns, kind, source, item.text, level, dict(item.data))]

    def due(self, now_ns: int) -> list[Notice]:
        """Return the held-back notices whose quiet time is over."""
        if not self._held:
            return []
        return [
            _notice(now_ns, key, held)
            for key, held in self._held.items()
            if held.count and now_ns - held.told_ns >= QUIET_NS
        ]

    def _hold(self, now_ns: int, source: str, kind: str, amount: int, text: str) -> list[Notice]:
        key = (source, kind)
        held = self._held.setdefault(key, _Held(told_ns=now_ns - QUIET_NS))
        held.count += 1
        held.amount += amount
        held.text = text
        return [_notice(now_ns, key, held)] if now_ns - held.told_ns >= QUIET_NS else []


def _notice(now_ns: int, key: tuple[str, str], held: _Held) -> Notice:
    source, kind = key
    if kind == "gap":
        text = f"{held.amount} sample{'s' if held.amount > 1 else ''} lost on the way"
        data: dict[str, object] = {"gaps": held.count, "lost": held.amount}
    else:
        text = f"{held.amount} bytes made no message: {held.text}"
        data = {"runs": held.count, "discarded_bytes": held.amount}
    held.told_ns, held.count, held.amount = now_ns, 0, 0
    return Notice(now_ns, "wire", source, text, "warning", data)
