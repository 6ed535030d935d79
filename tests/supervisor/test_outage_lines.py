"""One log line for each sensor and outage."""

from __future__ import annotations

from jointfit_daemon.pipeline.events import Notice, NoticeKind
from jointfit_daemon.supervisor._outage_lines import LONGEST_S, OutageLines


def sensor(state: str) -> Notice:
    return Notice(0, NoticeKind.SENSOR, "S1", state, data={"state": state})


def test_lost_sensor_has_no_line_beside_that_of_its_closed_source() -> None:
    lines = OutageLines()
    assert lines.holds(sensor("lost"), 10.0, 2.0)
    lines.close("S1")
    assert lines.due(100.0) == []
    assert not lines.holds(sensor("ok"), 20.0, 2.0)
    assert lines.holds(sensor("lost"), 30.0, None), "the closed source already has a line"
    assert lines.due(1000.0) == []


def test_lost_sensor_whose_source_is_not_closed_has_a_line() -> None:
    lines = OutageLines()
    assert lines.holds(sensor("lost"), 10.0, 2.0)
    assert lines.due(11.9) == []
    assert [notice.text for notice in lines.due(12.0)] == ["lost"]
    assert lines.due(13.0) == []
    assert not lines.holds(sensor("ok"), 14.0, 2.0)


def test_recovery_from_a_short_pause_has_no_line() -> None:
    lines = OutageLines()
    assert lines.holds(sensor("lost"), 10.0, 2.0)
    assert lines.holds(sensor("ok"), 11.0, 2.0)
    assert lines.due(100.0) == []


def test_other_notices_have_lines_at_once() -> None:
    lines = OutageLines()
    assert not lines.holds(sensor("stuck"), 10.0, 2.0)
    assert not lines.holds(Notice(0, NoticeKind.DEVICE, "S1", "closed"), 10.0, 2.0)


def test_sensors_lost_in_a_stall_of_the_host_have_a_line_only_if_they_stay_lost() -> None:
    lines = OutageLines()
    assert lines.holds(sensor("lost"), 10.0, 2.0)
    lines.postpone(10.1)
    assert lines.due(13.0) == []
    assert lines.holds(sensor("ok"), 13.0, 2.0)

    lines.postpone(20.0)
    assert lines.holds(sensor("lost"), 20.1, 2.0), "a loss soon after a stall is postponed"
    assert lines.due(23.9) == []
    assert [notice.text for notice in lines.due(24.0)] == ["lost"]


def test_a_dead_sensor_has_a_line_within_a_bound_though_the_host_stalls_all_the_time() -> None:
    lines = OutageLines()
    assert lines.holds(sensor("lost"), 10.0, 2.0)
    times_s = [10.0 + step for step in range(60)]
    reported_s = []
    for now_s in times_s:
        lines.postpone(now_s)
        reported_s += [now_s] * len(lines.due(now_s))
    assert reported_s == [10.0 + LONGEST_S]
