"""What fusion has to say of sensors, as notices. Law: words only; nothing is judged here."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.pipeline.events import Notice

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.fusion.faults import SensorReport


def sensor_notices(now_ns: int, news: Iterable[SensorReport]) -> list[Notice]:
    """Return one notice for each change, its new state under ``data.state``."""
    return [
        Notice(now_ns, "sensor", one.id, one.text, one.level, {"state": one.state, **one.data})
        for one in news
    ]
