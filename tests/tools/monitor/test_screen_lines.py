"""`screen_lines` fits every state into every terminal, and explains states and faults."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.outputs.payload_models import Info
from jointfit_daemon.tools.monitor._limb_figure import _bones
from jointfit_daemon.tools.monitor._monitor_state import VIEWS, MonitorState
from jointfit_daemon.tools.monitor._screen_lines import screen_lines
from jointfit_daemon.tools.monitor._text_lines import Line, fit_text, wrap
from tests.tools.monitor.sample_rig import (
    RECORDING,
    SampleRig,
    connected_state,
    live_state,
    moment,
    take,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

SIX = {f"segment {k}": [f"IMU {2 * k}", f"IMU {2 * k + 1}"] for k in range(6)}
RIGS = {
    "leg": SampleRig(),
    "six": SampleRig(sensors=SIX, joints=tuple(f"joint {k}" for k in range(7))),
    "one": SampleRig(sensors={"hand": ["S1"]}, joints=("wrist", "fingers"), cameras=False),
    "scripts": SampleRig(name="ساق اليسرى", sensors={"大腿": ["传感器一"], "小腿": ["传感器二"]},
                         joints=("臀部", "膝盖", "脚踝")),
    "hostile": SampleRig(name="a" * 300, sensors={"\x1b[2J": ["e\u0301\u200d"], "ﷺ": ["👩‍👧"]}),
}  # fmt: skip
STATES = {name: live_state(rig, 3.0) for name, rig in RIGS.items()}
STATES["empty"] = MonitorState("localhost:1883")


def text(state: MonitorState, width: int = 80, height: int = 24, at_s: float = 3.1) -> str:
    return "\n".join(
        line.text.rstrip() for line in screen_lines(state, width, height, moment(at_s))
    )


def words(state: MonitorState, width: int = 80, at_s: float = 3.1) -> str:
    """Return the text of the screen without line breaks; consecutive blanks become one blank."""
    return " ".join(text(state, width, 60, at_s).split())


@given(
    st.sampled_from([*STATES]), st.sampled_from(VIEWS),
    st.tuples(st.integers(1, 200), st.integers(1, 60)), st.booleans(), st.floats(0, 1e6),
)  # fmt: skip
@settings(max_examples=120, deadline=None)
def test_the_screen_always_has_its_size(
    name: str, view: str, size: tuple[int, int], unicode: bool, at_s: float
) -> None:
    width, height = size
    state = STATES[name]
    state.view, state.unicode = view, unicode  # type: ignore[assignment]
    lines = screen_lines(state, width, height, moment(at_s))
    assert len(lines) == height
    assert {line.width for line in lines} == {width}
    assert all(line.text.isprintable() for line in lines)
    if not unicode:
        assert all(line.text.isascii() for line in lines)


@given(st.text(max_size=60), st.integers(0, 40))
def test_fitted_text_has_its_width(content: str, width: int) -> None:
    assert Line.of(fit_text(content, width)).width == width
    assert Line.of(content).fit(width).width == width


@given(st.text(st.characters(categories=("L", "P")), max_size=80), st.integers(4, 40))
def test_wrapped_text_keeps_every_character(content: str, width: int) -> None:
    lines = wrap(content, width, indent=2)
    assert all(line.width <= width for line in lines)
    assert "".join("".join(line.text.split()) for line in lines) == "".join(content.split())


def test_the_live_view_shows_angle_deviation_and_devices() -> None:
    found = words(live_state(SampleRig(offline=frozenset({"S4"})), 3.0), 100)
    for part in ("bench-1", "Calibrated, version 3, 2 h ago", "● rec 0:12:07", "localhost:1883",
                 "08:34:23", "Knee flexion", "± 2.1°",
                 "S1 thigh 100.0 Hz 0.01 % fitted ±20 µs ✔ Works",
                 "S4 shank – 0.01 % – ✖ No data: check cable, power", "q quit"):  # fmt: skip
        assert part in found


@pytest.mark.parametrize(
    ("age_us", "expected"),
    [(0, "just now"), (61e6, "1 min ago"), (7.4e9, "2 h ago"), (9e11, "10 days")],
)
def test_the_age_of_the_calibration_is_that_by_the_clock_of_the_gateway(
    age_us: float, expected: str
) -> None:
    state = live_state(SampleRig(clock_offset_s=-7200.0), 3.0)
    assert state.rig.calibration is not None
    now_us = state.rig.gateway_us(moment(3.0))
    assert now_us is not None
    made = datetime.fromtimestamp((now_us - age_us) / 1e6, UTC)
    state.rig.calibration.created_utc = made.isoformat()
    assert f"version 3, {expected}" in words(state, 100)


def test_a_recording_that_is_off_and_its_last_file_are_shown() -> None:
    state = live_state(SampleRig(recording=RECORDING | {"active": False}), 3.0)
    assert "○ not recording" in words(state)
    assert "R record" in words(state)
    state.press("4")
    assert (
        "not recording; last file bench-1-20261121T082216-0001.mcap, 0:12:04, 48.2 MB; 93.2 GB free"
        in words(state)
    )


def styles_of(state: MonitorState, style: str) -> Sequence[str]:
    lines = screen_lines(state, 80, 24, moment(3.1))
    return [content for line in lines for content, each in line.spans if each == style]


def test_red_is_only_for_what_needs_a_person() -> None:
    assert styles_of(live_state(SampleRig(), 3.0), "error") == []
    (red,) = styles_of(live_state(SampleRig(offline=frozenset({"S4"})), 3.0), "error")
    assert red.startswith("✖ No data")


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        (("stuck:S2",), "S2 repeats its value and is not used."),
        (("lost:shank",), "No data from the sensors of shank."),
        (("extrapolating",), "Works"),
    ],
)
def test_a_limitation_is_a_sentence(flags: tuple[str, ...], expected: str) -> None:
    assert expected in words(live_state(SampleRig(), 3.0, flags))


def test_lost_broker_and_stopped_daemon_are_told_apart() -> None:
    state = live_state(SampleRig(), 3.0)
    state.set_lost("broker localhost:1883: connection refused: start the broker")
    found = words(state)
    assert "Broker lost" in found
    assert "start the broker" in found
    assert "jointfitd is not running" not in found
    state.set_connected()
    take(state, "bridge/state", {"v": 1, "state": "offline"})
    found = words(state)
    assert "✖ jointfitd is not running" in found
    assert "systemctl status jointfitd" in found
    assert "Broker lost" not in found


def test_an_old_angle_is_not_shown_and_a_silent_daemon_is_reported() -> None:
    state = live_state(SampleRig(), 3.0)
    assert "± 2.1°" in words(state)
    found = words(state, at_s=8.0)
    assert "± 2.1°" not in found
    assert "No pose for 5 s" in found


def test_without_a_daemon_the_command_to_start_it_is_shown() -> None:
    found = words(connected_state())
    assert "Waiting for jointfitd on localhost:1883" in found
    assert "jointfitd --config rig.toml" in found


def test_a_daemon_of_another_version_is_not_taken_for_a_missing_one() -> None:
    state = connected_state()
    for topic, payload in SampleRig().retained().items():
        state.rig.take(topic, payload | {"v": 2}, moment(0.0))
    found = words(state)
    assert "✖ The messages of jointfitd cannot be read" in found
    assert "payload version 2, this program reads 1" in found
    assert "install the version" in found
    assert "no rig publishes" not in found


def test_missing_layout_and_missing_poses_name_the_right_to_read() -> None:
    state = connected_state()
    take(state, "pose/ui", SampleRig(joints=()).pose(0.0))
    take(state, "bridge/state", {"v": 1, "state": "online"})
    assert "bridge/info) is missing: the account cannot read it" in words(state, at_s=0.1)
    state = connected_state()
    take(state, "bridge/state", {"v": 1, "state": "online"})
    assert "account cannot read this topic" in words(state)


def test_the_clock_of_the_gateway_is_compared_with_this_one() -> None:
    assert "behind" not in words(live_state(SampleRig(), 3.0))
    assert "(9 h behind)" in words(live_state(SampleRig(clock_offset_s=-9 * 3600.0), 3.0))


def test_calibration_shows_progress_missing_movement_and_predicted_errors() -> None:
    state = live_state(SampleRig(), 3.0)
    take(state, "calibration", SampleRig().calibration("functional"))
    take(state, "calibration/progress", SampleRig().progress())
    state.press("2")
    found = words(state)
    for part in ("Functional phase runs 40 %", "▲ knee: 9 of 12 flexions so far: walk, squat",
                 "Knee ± 21 mm ± 2.1 mm 64° markers, static pose ○ more movement",
                 "Hip ± 21 mm ± 2.1 mm 64° markers ✔ enough", "shank 100 %",
                 "x stop phase"):  # fmt: skip
        assert part in found


def test_a_rejected_and_an_aborted_calibration_have_reason_and_remedy() -> None:
    state = live_state(SampleRig(), 3.0)
    state.press("2")
    kept = "knee: flexion error 5.1 deg, was 2.3: repeat the movement"
    take(state, "calibration", SampleRig().calibration(kept=kept))
    assert f"✖ Rejected: {kept}" in words(state)
    assert "Key F repeats" in words(state)
    text_ = "the subject moved: stand still and repeat"
    take(state, "calibration", SampleRig().calibration("aborted", text=text_))
    assert f"✖ Calibration aborted: {text_}" in words(state)


def test_the_next_phase_of_a_rig_without_cameras_is_the_static_pose() -> None:
    sample = SampleRig(cameras=False)
    state = live_state(sample, 1.0)
    take(state, "calibration", sample.calibration("uncalibrated"))
    state.press("2")
    assert "▶ 1 Stand still key s" in words(state)
    assert "Align the sensors" not in words(state)


def test_the_history_shows_errors_and_the_version_in_force() -> None:
    state = live_state(SampleRig(), 3.0)
    state.press("3")
    state.take_answer("calibrations", {"status": "ok", "data": SampleRig().versions()}, 0.0)
    found = words(state)
    assert "▶ 3 2026-11-23 09:30 anchored Knee flexion 2.6° ✔ in force" in found
    assert "○ of another limb" in found
    assert "Version 3: Knee flexion 2.6°" in words(state, 40)


def test_the_log_is_newest_first_and_can_be_reduced_to_warnings() -> None:
    sample, state = SampleRig(), live_state(SampleRig(), 3.0)
    take(state, "bridge/event", sample.event("connected"))
    take(state, "bridge/event", sample.event("no data for 3 s", level="warning", at_s=2.0))
    state.press("5")
    found = text(state)
    assert found.index("08:34:22 ▲ S3: no data") < found.index("08:34:20 ○ S3: connected")
    state.press("w")
    assert "connected" not in text(state)


def test_health_lists_counters_and_faults_of_the_daemon() -> None:
    sample, state = SampleRig(), live_state(SampleRig(), 3.0)
    health = sample.health()
    health["link"]["denied"] = ["pose"]
    health["state"]["fault"] = "state directory is full: free some space"
    stages = ("decoded", "aligned", "fused", "encoded", "written", "total")
    delays = {"p50": 655.4, "p99": 1638.4, "max": 2904.5}
    health["latency"] = {"frames": 1000} | {f"{stage}_us": delays for stage in stages}
    take(state, "bridge/health", health)
    state.press("4")
    found = words(state)
    for part in ("81230 received, 81218 used", "0.3 ms median", "▲ the broker refuses pose",
                 "✖ state directory is full", "9.1 % of a core", "written 1.64",
                 "0.7 ms from arrival to broker (median), 1.6 ms (p99)"):  # fmt: skip
        assert part in found


def test_long_views_scroll_and_state_how_much_follows() -> None:
    state = live_state(SampleRig(), 3.0)
    state.press("4")
    first = text(state)
    assert "more lines: key ↓" in first
    for _ in range(9):
        state.press("pagedown")
    last = text(state)
    assert "rig bench-1" in last
    state.press("up")
    assert text(state) != last


def test_several_rigs_are_offered() -> None:
    state = MonitorState("localhost:1883")
    state.set_found_rigs({"jointfit/a": "left leg", "jointfit/b": "right leg"})
    assert "▶ left leg (jointfit/a)" in words(state)
    assert "Enter show" in words(state)


def test_the_segments_of_two_legs_connect_the_joints_of_each_side() -> None:
    joints = {
        f"{side}_{name}": {"parent": parent if parent == "pelvis" else f"{side}_{parent}",
                           "child": child and f"{side}_{child}", "side": side}
        for side in ("left", "right")
        for name, parent, child in (
            ("hip", "pelvis", "thigh"), ("knee", "thigh", "shank"), ("ankle", "shank", None)
        )
    }  # fmt: skip
    segments = ["pelvis", "left_thigh", "right_thigh", "left_shank", "right_shank"]
    more = {"side": "both", "joints": [*joints], "segments": segments, "connections": joints}
    info = Info.model_validate(SampleRig().info() | more)
    assert {frozenset(bone) for bone in _bones(info)} == {
        frozenset({"left_hip", "right_hip"}),
        *(frozenset({f"{side}_hip", f"{side}_knee"}) for side in ("left", "right")),
        *(frozenset({f"{side}_knee", f"{side}_ankle"}) for side in ("left", "right")),
    }
