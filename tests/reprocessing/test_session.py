"""A recording becomes arrays, with the recorded configuration or with another one."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.model import (
    FrameFlag,
    FusionMode,
    JointAngles,
    JointState,
    LimbState,
    SyncState,
)
from jointfit_daemon.outputs.recording import PROGRAM, _session_writer
from jointfit_daemon.pipeline.events import Configured, Tick
from jointfit_daemon.reprocessing import Changes, ReprocessingError, load_session, process_events
from jointfit_daemon.reprocessing._session_collector import SessionCollector
from tests.pipeline import core_feed
from tests.pipeline.core_feed import BEGIN_NS, SENSORS
from tests.reprocessing.recorded_run import (
    END,
    FITTED,
    UNIX_NS,
    RecordedRun,
    record_run,
    rig_table,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.session_data import SessionData


@pytest.fixture(scope="module")
def session(run: RecordedRun) -> SessionData:
    return load_session(run.path)


def test_session_has_every_sample_with_its_instant(session: SessionData) -> None:
    assert [sensor.id for sensor in session.sensors] == list(SENSORS)
    assert [sensor.segment for sensor in session.sensors] == ["thigh", "thigh", "shank", "shank"]
    assert session.start_unix_ns == BEGIN_NS + UNIX_NS
    for sensor in session.sensors:
        numbers = np.round(sensor.t_s / 0.01).astype(int)
        moving = numbers > FITTED + 2
        expected = [core_feed.orientation(sensor.id, number) for number in numbers[moving]]
        assert len(expected) > 0.9 * (END - FITTED)
        found = sensor.orientation[moving]
        assert np.abs(np.abs((found * expected).sum(axis=1)) - 1.0).max() < 1e-4
        assert sensor.acceleration is None


def test_session_has_the_segments_and_joints_of_the_run(
    session: SessionData, run: RecordedRun
) -> None:
    thigh, knee = session.segments[0], session.joints[1]
    assert (thigh.name, knee.name) == ("thigh", "knee")
    assert len(thigh.t_s) == len(knee.t_s) == run.states
    # The orientation is unknown before the calibration.
    assert np.isnan(thigh.orientation[:50]).all()
    after = thigh.t_s > 0.01 * (FITTED + 2)
    assert np.isfinite(thigh.orientation[after]).all()
    assert np.isfinite(knee.angles["flexion"][after]).all()


def test_session_names_its_subject_and_the_program_that_recorded_it(
    session: SessionData, run: RecordedRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert session.description["subject"] == "subject-07"
    assert session.description["software"] == PROGRAM
    assert "processed" not in session.description

    without = parse_rig(rig_table() | {"calibration": {"static_s": 1.0}})
    assert "subject" not in load_session(run.path, without).description

    monkeypatch.setattr(_session_writer, "SOFTWARE", "jointfitd 0.0.9, mcap 1")
    record_run(tmp_path)
    older = load_session(tmp_path).description
    assert (older["software"], older["processed"]) == ("jointfitd 0.0.9", PROGRAM)


def test_marks_phases_and_losses_are_on_the_time_line(session: SessionData) -> None:
    found = {(event.kind, event.id): event for event in session.events}
    assert found["mark", "r"].text == "first step"
    assert found["mark", "r"].t_s == pytest.approx(3.0)
    assert found["calibration", "static"].t_s == pytest.approx(0.2)
    assert ("device", "S1") in found
    assert ("reload", "r") in found


def test_positions_from_the_fixed_origin_are_unknown_beside_measured_positions() -> None:
    """Positions from both origins in one column would jump by the distance between the origins."""
    collector = SessionCollector()
    hip = JointState("hip", (0.0, 0.0, 0.9), 0.002, JointAngles(0.1, 0.0, 0.0))
    modes: list[tuple[FusionMode, tuple[str, ...]]] = [
        (FusionMode.IMU_AND_MOCAP, ()),
        (FusionMode.IMU_AND_MOCAP, (FrameFlag.ORIGIN_FIXED,)),
        (FusionMode.IMU, ()),
        (FusionMode.IMU_AND_MOCAP, ()),
    ]
    for number, (mode, flags) in enumerate(modes):
        t_ns = BEGIN_NS + 10_000_000 * number
        state = LimbState(number, t_ns, t_ns, mode, SyncState.LOCKED, flags, (), (hip,))
        collector.add_event(Tick(t_ns), [state])
    found = collector.session(parse_rig(rig_table()), {}, {})
    (joint,) = found.joints
    assert joint.position is not None
    assert joint.position_sd is not None
    assert np.isnan(joint.position[:, 0]).tolist() == [False, True, True, False]
    assert np.isnan(joint.position_sd).tolist() == [False, True, True, False]
    assert np.isfinite(joint.angles["flexion"]).all()
    (event,) = found.events
    assert event.kind == "positions"
    assert "in 2 of 4 frames" in event.text
    assert found.frames is not None
    assert found.frames.t_s.tolist() == joint.t_s.tolist()
    assert found.frames.modes == ("imu+mocap", "imu+mocap", "imu", "imu+mocap")
    assert found.frames.flags == ("", "origin_fixed", "", "")


def test_calibration_given_is_in_force_from_the_first_frame(run: RecordedRun) -> None:
    session = load_session(run.path, calibration=run.calibration)
    thigh = session.segments[0]
    early = (thigh.t_s > 0.2) & (thigh.t_s < 1.5)
    assert np.isfinite(thigh.orientation[early]).all()
    assert not any(event.id == "static" for event in session.events)


def test_another_rig_gives_the_frames_of_that_rig(run: RecordedRun) -> None:
    half = parse_rig(rig_table(output_rate_hz=50))
    session = load_session(run.path, rig=half)
    assert np.median(np.diff(session.segments[0].t_s)) == pytest.approx(0.02)
    assert np.isfinite(session.segments[0].orientation[-50:]).all()  # the fit was computed again


def test_sensor_missing_from_the_recording_is_an_error_with_the_known_ones(
    run: RecordedRun,
) -> None:
    table = rig_table()
    table["imu"][1]["id"] = "S9"
    with pytest.raises(ReprocessingError, match=r"no source 'S9', expected one of: S1 \(xbus\)"):
        load_session(run.path, rig=parse_rig(table))


def test_sensor_of_another_driver_is_an_error(run: RecordedRun) -> None:
    table = rig_table()
    spare = {"sample_time": 0x305, "group_counter": 0x306, "quaternion": 0x321}
    table["imu"][2] = table["imu"][1] | {"id": "S3", "segment": "shank", "ids": spare}
    with pytest.raises(ReprocessingError, match="'S3': recorded with driver 'xbus'"):
        load_session(run.path, rig=parse_rig(table))


def test_calibration_of_another_limb_is_an_error(run: RecordedRun) -> None:
    other = replace(run.calibration, segments=("thorax", "arm"))
    with pytest.raises(ReprocessingError, match="belongs to another limb"):
        load_session(run.path, calibration=other)


def test_a_reload_with_another_limb_ends_the_use_of_the_calibration(run: RecordedRun) -> None:
    rig = parse_rig(rig_table())
    other = replace(rig, chain=replace(rig.chain, segments=("upper_arm", "forearm")))
    recorded = [Configured(BEGIN_NS, rig, run.calibration), Configured(BEGIN_NS + 1, other, None)]
    processed = [event for event, _ in process_events(recorded, Changes(compute_fits=True))]
    assert [getattr(event, "calibration", "absent") for event in processed] == [
        run.calibration,
        None,
    ]
