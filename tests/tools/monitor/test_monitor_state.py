"""`MonitorState` converts keys to requests, and answers to texts, without a terminal."""

from __future__ import annotations

from typing import Any

import pytest

from jointfit_daemon.supervisor.requests import REQUESTS
from jointfit_daemon.tools.monitor._monitor_state import (
    AskMark,
    ChooseRig,
    MonitorState,
    Quit,
    SendRequest,
    chosen_angle,
)
from tests.tools.monitor.sample_rig import RECORDING, SampleRig, connected_state, live_state, take


def calibrating() -> MonitorState:
    state = live_state(SampleRig(), 0.5)
    take(state, "calibration", SampleRig().calibration("functional"))
    return state


@pytest.mark.parametrize("key", ["q", "ctrl+c", "ctrl+q"])
def test_quitting_keys(key: str) -> None:
    assert connected_state().press(key) == Quit()


def test_one_key_records_a_static_pose_in_every_view_unless_a_phase_runs() -> None:
    for view in "12345":
        state = live_state(SampleRig(), 0.5)
        state.press(view)
        assert state.press("s") == SendRequest("static")
    assert calibrating().press("s") is None


def test_other_phases_start_in_their_view_only_and_a_running_phase_can_be_stopped() -> None:
    state = live_state(SampleRig(), 0.5)
    assert [state.press(key) for key in "afFx"] == [None] * 4
    state.press("2")
    assert [state.press(key) for key in "afF"] == [
        SendRequest("calibrate", {"phase": "align"}),
        SendRequest("calibrate", {"phase": "functional"}),
        SendRequest("calibrate", {"phase": "functional", "force": True}),
    ]
    state = calibrating()
    state.press("2")
    assert state.press("f") is None
    assert state.press("x") == SendRequest("calibrate", {"phase": "abort"})


def test_one_key_starts_the_recording_and_pressed_twice_stops_it() -> None:
    state = live_state(SampleRig(recording=RECORDING | {"active": False}), 0.5)
    assert state.press("R") == SendRequest("record", {"action": "start"})
    take(state, "bridge/health", SampleRig().health())
    assert state.press("R") is None
    assert state.press("j") is None
    assert state.press("R") is None  # the other key cancelled the first press of R
    assert state.press("R") == SendRequest("record", {"action": "stop"})
    answer = {"status": "ok", "data": {"directory": "/state", "file": "a.mcap", "active": False}}
    state.take_answer("record", answer, 0.0)
    assert state.notice is not None
    assert state.notice.text == "recorded a.mcap in /state"


def test_every_request_of_a_key_is_one_that_the_daemon_knows() -> None:
    requests = [SendRequest("static"), SendRequest("calibrate", {"phase": "align"}),
                SendRequest("calibrate", {"phase": "functional", "force": True}),
                SendRequest("use-calibration", {"version": 2}), SendRequest("calibrations"),
                SendRequest("use-calibration", {"revert": True}),
                SendRequest("record", {"action": "start"}),
                SendRequest("record", {"action": "stop"})]  # fmt: skip
    for request in requests:
        REQUESTS[request.command].model.model_validate(dict(request.arguments))


def test_the_history_is_read_once_for_each_calibration_and_a_version_is_used() -> None:
    state = live_state(SampleRig(), 0.5)
    assert state.due_request() is None
    state.press("3")
    assert state.due_request() == SendRequest("calibrations")
    assert state.due_request() is None
    state.take_answer("calibrations", {"status": "ok", "data": SampleRig().versions()}, 0.0)
    state.press("down")
    assert state.press("enter") == SendRequest("use-calibration", {"version": 2})
    assert state.press("r") == SendRequest("use-calibration", {"revert": True})
    take(state, "calibration", SampleRig().calibration(version=4))
    assert state.due_request() == SendRequest("calibrations")


@pytest.mark.parametrize("data", [{}, {"versions": 3}, None, [1]])
def test_an_answer_that_cannot_be_read_is_reported(data: Any) -> None:
    state = live_state(SampleRig(), 0.5)
    state.take_answer("calibrations", {"status": "ok", "data": data}, 0.0)
    assert "calibrations" in state.stored_fault
    assert state.chosen_version() is None


def test_a_refusal_names_its_reason() -> None:
    state = live_state(SampleRig(), 0.5)
    fault = {"key": "phase", "message": "a phase runs already: abort it first"}
    answer = {"status": "error", "data": {}, "error": {**fault, "faults": [fault], "more": 0}}
    state.take_answer("static", answer, 5.0)
    assert state.notice is not None
    assert state.notice.refused
    assert state.notice.text == "jointfitd refuses static: a phase runs already: abort it first"


def test_the_angle_is_chosen_in_the_order_of_the_joints() -> None:
    state = live_state(SampleRig(), 0.5)
    assert chosen_angle(state) == ("knee", "flexion_deg")
    found = []
    for _ in range(4):
        state.press("j")
        found.append(chosen_angle(state))
    assert found[-1] == ("knee", "flexion_deg")
    assert len(set(found)) == 4
    state.press("J")
    assert chosen_angle(state) == found[-2]


def test_one_rig_is_chosen_and_several_are_offered() -> None:
    state = MonitorState("broker")
    state.set_connected()
    assert state.set_found_rigs({"jointfit/a": "A"}) == "jointfit/a"
    assert state.set_found_rigs({"jointfit/b": "B", "jointfit/a": "A"}) is None
    state.press("down")
    assert state.press("enter") == ChooseRig("jointfit/b")
    assert state.set_found_rigs({}) is None
    assert state.press("enter") is None


def test_a_mark_asks_for_its_text() -> None:
    assert live_state(SampleRig(), 0.5).press("m") == AskMark()
