"""State of online learning: obstacles, their durations and notices."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.outputs.payloads._health_encoding import learning_payload
from jointfit_daemon.pipeline.online_learning import (
    OnlineFrameCollector,
    OnlineRefits,
    only_models_differ,
)
from jointfit_daemon.pipeline.online_learning._learning_state import (
    REPORT_NS,
    LearningMonitor,
    not_visible,
)
from jointfit_daemon.timing.alignment import AlignedFrame
from tests.calibration.calibrated_subject import CHAIN, calibration

MS, S = 1_000_000, 1_000_000_000
SENSORS = ("S1", "S2", "S3")
LAYOUT = MocapLayout(("A", "B", "C", "D"), ())
NO_SENSORS: frozenset[str] = frozenset()


def collector(*, wanted: bool = True, **changed: Any) -> OnlineFrameCollector:
    return OnlineFrameCollector(CHAIN, replace(calibration(), **changed), wanted=wanted)


def feed(
    one: OnlineFrameCollector,
    seconds: float,
    begin_s: float = 0.0,
    *,
    unseen: tuple[int, ...] = (),
    missing: str = "",
    flags: tuple[str, ...] = (),
    layout: MocapLayout = LAYOUT,
) -> list[str]:
    """Feed sensors and mocap frames at 20 Hz; return the notices."""
    notices = []
    for k in range(round(begin_s * 20), round((begin_s + seconds) * 20)):
        t_ns = k * 50 * MS
        markers = np.full((4, 3), 0.5)
        markers[list(unseen)] = np.nan
        nothing = np.zeros((0, 3)), np.zeros((0, 4))
        one.add_mocap(t_ns, MocapFrame(t_ns, 0, None, layout, markers, *nothing))
        q = math.cos(t_ns / S), math.sin(t_ns / S), 0.0, 0.0
        said = {name: q for name in SENSORS if name != missing}
        one.add_frame(AlignedFrame(t_ns, t_ns, said, NO_SENSORS, NO_SENSORS, True), flags)
        notices += [f"{notice.level}: {notice.text}" for notice in one.notices(t_ns)]
    return notices


def state(one: OnlineFrameCollector, now_s: float) -> tuple[Any, Any]:
    found = learning_payload(one.health(round(now_s * S)))
    return found["state"], found["reason"]


def test_missing_marker_is_named_and_reported_once() -> None:
    one = collector()
    assert feed(one, 10.0) == []
    assert state(one, 10.0) == ("learning", None)
    (notices,) = feed(one, 150.0, 10.0, unseen=(1,))
    assert notices == "warning: online learning stopped for 60 s: not visible to the cameras: B"
    assert state(one, 160.0) == ("stopped", "not visible to the cameras: B")
    assert learning_payload(one.health(160 * S))["stopped_s"] == pytest.approx(150.0, abs=0.3)
    assert feed(one, 5.0, 160.0) == ["info: online learning resumed"]
    assert learning_payload(one.health(165 * S))["stopped_s"] is None


def test_marker_missing_from_the_start_is_reported() -> None:
    assert len(feed(collector(), 70.0, unseen=(0,))) == 1


def test_short_occlusions_are_not_reported() -> None:
    one = collector()
    for k in range(4):
        assert feed(one, 40.0, 50.0 * k, unseen=(2,)) == []
        assert feed(one, 10.0, 50.0 * k + 40.0) == []


def test_absence_from_view_is_no_obstacle() -> None:
    one = collector()
    assert feed(one, 100.0, unseen=(0, 1, 2, 3)) == []
    assert state(one, 100.0)[0] == "waiting"
    assert feed(one, 50.0, 100.0, unseen=(0,)) == []


def test_mocap_that_is_off_is_no_obstacle() -> None:
    one = collector()
    feed(one, 5.0)
    assert one.notices(200 * S) == []
    assert state(one, 200.0) == ("waiting", "no live mocap frames")


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"missing": "S2"}, "no data from S2"),
        ({"flags": ("slipped:S1",)}, "sensor slipped (S1)"),
        ({"flags": ("heading_disagrees:knee",)}, "headings contradict each other (knee)"),
        (
            {"flags": ("one_sensor:thigh", "one_sensor:shank", "imu_only")},
            "one working sensor only (thigh, shank)",
        ),
        ({"layout": MocapLayout(("A", "B", "C", "X"), ())}, "missing in the mocap stream: D"),
    ],
)
def test_every_obstacle_has_its_reason(how: dict[str, Any], why: str) -> None:
    one = collector()
    (notices,) = feed(one, 70.0, **how)
    assert notices.endswith(why)
    assert state(one, 70.0)[0] == "stopped"


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"wanted": False}, "learn_online is off in rig.toml"),
        ({"memory": ""}, "run the functional phase once"),
        ({"clusters": {}}, "has no markers on thigh"),
    ],
)
def test_excluded_learning_gives_a_reason_and_no_notice(how: dict[str, Any], why: str) -> None:
    one = collector(**how)
    assert feed(one, 70.0) == []
    off, reason = state(one, 70.0)
    assert off == "off"
    assert why in reason


def test_paused_learning_gives_its_reason() -> None:
    one = collector()
    feed(one, 5.0)
    found = OnlineRefits(paused=True).health(one, 5 * S)
    assert found.state == "off"
    assert "paused by a request" in str(found.reason)


def test_long_lists_of_markers_are_shortened() -> None:
    assert not_visible([f"M{k}" for k in range(9)]).endswith("M0, M1, M2, M3 and 5 more")


def test_monitor_without_frames_gives_no_notice() -> None:
    assert LearningMonitor().notices(2 * REPORT_NS) == []


def test_correlations_belong_to_the_models() -> None:
    """Online learning may change the models and their error correlations, and nothing else."""
    before = calibration()
    assert only_models_differ(before, replace(before, correlations={"knee": 0.5}))
    assert not only_models_differ(
        before, replace(before, links=()) if before.links else _other(before)
    )


def _other(before: Any) -> Any:
    return replace(before, flags=("headings_from_static",))
