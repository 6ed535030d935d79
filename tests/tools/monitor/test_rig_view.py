"""`RigView` accepts any messages, even faulty messages, and needs limited memory."""

from __future__ import annotations

import sys
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.tools.monitor._rig_view import TOPICS, RigView
from tests.tools.monitor.sample_rig import SampleRig, connected_state, live_state, moment, take

JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner),
    max_leaves=12,
)
NAMES = ("bridge/state", "bridge/info", "bridge/health", "bridge/event", "calibration",
         "calibration/progress", "device/S1/availability", "pose/ui", "optical/pose",
         "device/x", "no/such/topic")  # fmt: skip


@given(st.lists(st.tuples(st.sampled_from(NAMES), JSON), max_size=6))
@settings(max_examples=60, deadline=None)
def test_no_payload_breaks_the_state(messages: list[tuple[str, Any]]) -> None:
    rig = RigView()
    for topic, payload in messages:
        rig.take(topic, payload, moment(0.0))
    assert rig.pose is None
    assert set(rig.faults) <= {*TOPICS, "device"}


def test_unknown_keys_at_any_depth_are_ignored() -> None:
    sample, state = SampleRig(), connected_state()
    pose, health = sample.pose(0.0), sample.health()
    pose["new"] = 1
    pose["joints"]["knee"]["torque_nm"] = [1]
    health["devices"]["S1"]["colour"] = "red"
    state.rig.take("pose/ui", pose, moment(0.0))
    state.rig.take("bridge/health", health, moment(0.0))
    assert state.rig.pose is not None
    assert state.rig.health is not None
    assert not state.rig.faults


def test_a_payload_of_another_version_is_reported_until_one_can_be_read() -> None:
    sample, rig = SampleRig(), RigView()
    rig.take("pose/ui", sample.pose(0.0) | {"v": 2}, moment(0.0))
    assert "payload version 2, this program reads 1" in rig.faults["pose/ui"]
    rig.take("pose/ui", {k: v for k, v in sample.pose(0.0).items() if k != "seq"}, moment(0.0))
    assert rig.faults["pose/ui"].startswith("pose/ui: seq: field required")
    rig.take("pose/ui", sample.pose(0.0), moment(0.0))
    assert not rig.faults


def test_texts_cannot_control_the_terminal() -> None:
    sample, state = SampleRig(name="a\x1b[2Jb"), connected_state()
    take(state, "bridge/info", sample.info())
    take(state, "bridge/event", sample.event("\x1b]0;title\x07\u202eevil\n"))
    assert state.rig.info is not None
    shown = state.rig.info.rig + state.rig.events[0].text
    assert shown.isprintable()
    assert "\\x1b" in shown


def test_memory_is_bounded_for_days_of_messages() -> None:
    sample, rig = SampleRig(), RigView()
    pose, optical = sample.pose(0.0), sample.optical(0.0)
    for k in range(3000):
        at = {"t_us": sample.t_us(0.01 * k)}
        rig.take("pose/ui", pose | at, moment(0.01 * k))
        rig.take("optical/pose", optical | at, moment(0.01 * k))
        rig.take("bridge/event", sample.event("lost", id=f"device {k}"), moment(0.01 * k))
        rig.take(f"device/{k}/availability", {"v": 1, "state": "online"}, moment(0.01 * k))
        rig.take(f"device/{k}/availability", {"v": 9}, moment(0.01 * k))
    assert (len(rig.poses), len(rig.opticals), len(rig.events)) == (1000, 1000, 300)
    assert (len(rig.last_events), len(rig.availability), len(rig.faults)) == (200, 200, 1)
    assert sys.getsizeof(rig.poses) < 20_000


def test_the_curve_has_twenty_seconds_and_begins_anew_when_the_clock_goes_back() -> None:
    state = live_state(SampleRig(), 30.0)
    assert len(state.rig.poses) == 201
    take(state, "pose/ui", SampleRig(clock_offset_s=-3600.0).pose(30.1), 30.1)
    assert len(state.rig.poses) == 1
    assert len(state.rig.opticals) == 0


@pytest.mark.parametrize("hours", [-9, 9])
def test_a_gateway_whose_clock_is_hours_off_has_its_own_time(hours: int) -> None:
    state = live_state(SampleRig(clock_offset_s=3600.0 * hours), 1.0)
    assert state.rig.clock_error_us == 3600e6 * hours
    assert state.rig.gateway_us(moment(2.0)) == SampleRig().t_us(2.0 + 3600.0 * hours)


def test_a_new_phase_ends_the_progress_of_the_last_one() -> None:
    sample, state = SampleRig(), connected_state()
    take(state, "calibration", sample.calibration("functional"))
    take(state, "calibration/progress", sample.progress())
    assert state.rig.progress is not None
    take(state, "calibration", sample.calibration("fitting"))
    assert state.rig.progress is None
