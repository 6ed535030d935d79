"""Notices of lost and stuck sensors."""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING
from unittest.mock import patch

from jointfit_daemon.pipeline.events import Notice
from tests.pipeline import core_feed
from tests.pipeline.core_feed import BEGIN_NS, MS, PERIOD_NS, SENSORS, Bench, arrival_ns, opening

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.pipeline.events import Event


def samples(names: Iterable[str], first: int, end: int) -> list[Event]:
    found: list[Event] = [core_feed.chunk(s, k) for s in names for k in range(first, end)]
    return sorted(found, key=arrival_ns)


def reports(bench: Bench) -> list[tuple[float, str, object]]:
    """Return time (ms since the start), sensor and state of the notices."""
    return [
        ((o.t_ns - BEGIN_NS) / MS, o.id, o.data["state"])
        for o in bench.out
        if isinstance(o, Notice) and o.kind == "sensor"
    ]


def test_loss_and_recovery_of_a_sensor_are_reported() -> None:
    bench = Bench()
    bench.feed(opening())
    bench.feed(samples(SENSORS, 0, 100))
    bench.feed(samples(("S2", "S3", "S4"), 100, 200))
    bench.feed(samples(SENSORS, 200, 450))
    (lost_ms, lost, state), (back_ms, back, again) = reports(bench)
    assert (lost, state, back, again) == ("S1", "lost", "S1", "ok")
    assert 1000 < lost_ms < 1500
    assert 4000 < back_ms < 4500
    assert bench.devices()["S1"]["sensor"] == "ok"
    assert "sensor" not in bench.devices()["mocap"]


def test_loss_of_all_sensors_is_reported_and_frames_continue() -> None:
    bench = Bench()
    bench.feed(opening())
    bench.feed(samples(SENSORS, 0, 100))
    bench.wait_until(BEGIN_NS + 3000 * MS)
    assert [(name, state) for _, name, state in reports(bench)] == [(s, "lost") for s in SENSORS]
    assert all(1000 < t < 1500 for t, _, _ in reports(bench))
    grown = [b.t_ns - a.t_ns for a, b in itertools.pairwise(bench.states)]
    assert set(grown) == {PERIOD_NS}
    assert bench.states[-1].t_ns > BEGIN_NS + 2900 * MS


def test_stuck_sensor_is_reported_flagged_and_excluded() -> None:
    turning = core_feed.orientation
    bench = Bench()
    bench.feed(opening())
    bench.feed(samples(SENSORS, 0, 100))
    stuck = patch.object(core_feed, "orientation", lambda s, k: turning(s, 100 if s == "S3" else k))
    with stuck:
        bench.feed(samples(SENSORS, 100, 200))
    ((at_ms, name, state),) = reports(bench)
    assert (name, state) == ("S3", "stuck")
    assert 1000 < at_ms < 1500
    assert bench.devices()["S3"]["sensor"] == "stuck"
    assert bench.states[-1].t_ns > BEGIN_NS + 190 * PERIOD_NS
