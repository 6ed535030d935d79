"""Lag during operation: estimation, restarts of clocks, and notices of steps."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pytest

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import IDENTITY_ONE, as_quaternion
from jointfit_daemon.limb_model import Calibration, SensorCalibration, StoredCluster, rigid_fit
from jointfit_daemon.model import Chain, MocapFrame, MocapLayout
from jointfit_daemon.outputs.payloads._health_encoding import lag_payload
from jointfit_daemon.pipeline.sources import LagMonitor
from jointfit_daemon.pipeline.sources._lag_monitor import KnownLag

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.pipeline.events import Notice

MS = 1_000_000
CHAIN = Chain(("hip", "knee"), ("thigh",), (("S1",),))
NAMES = ("T1", "T2", "T3", "T4")
PLACES = ((0.1, 0.0, 0.0), (-0.05, 0.08, 0.02), (0.0, -0.07, 0.05), (0.02, 0.03, -0.1))
CALIBRATION = Calibration(
    method="anchored",
    joints=CHAIN.joints,
    segments=CHAIN.segments,
    chain_sensors=CHAIN.sensors,
    sensor={"S1": SensorCalibration(IDENTITY_ONE, IDENTITY_ONE, 2 * MS, 0.0)},
    segment={},
    joint={},
    clusters={"thigh": StoredCluster(NAMES, None, PLACES, (0.0, 0.0, 0.0), IDENTITY_ONE)},
    quality={"lag": {"S1": {"source": "plate and movement", "sigma_ns": 0.2 * MS}}},
)
MOUNT = rotation.exp(np.array([0.4, -0.9, 0.3]))


class TimedNotice(NamedTuple):
    t_s: float
    notice: Notice


def orientations(t_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return irregular rotations about three axes, exact at any instant."""
    parts = [
        rotation.exp(np.outer(1.1 * np.sin(2.9 * t_s + np.sin(0.7 * t_s)), [1.0, 0.0, 0.0])),
        rotation.exp(np.outer(0.9 * np.sin(4.3 * t_s + 1.3 * np.sin(0.5 * t_s)), [0.0, 1.0, 0.0])),
        rotation.exp(np.outer(0.8 * np.sin(3.7 * t_s + np.sin(1.1 * t_s)), [0.0, 0.0, 1.0])),
    ]
    return rotation.multiply(rotation.multiply(parts[0], parts[1]), parts[2])


def play(
    monitor: LagMonitor,
    seconds: float,
    lag_ms: float,
    *,
    start_s: float = 0.0,
    epoch: int = 0,
    still: bool = False,
    named: int = len(NAMES),
    tissue_rad: float = 0.0,
) -> list[TimedNotice]:
    """Feed IMU samples at 100 Hz and mocap frames at 120 Hz; return the notices.

    The mocap frames contain the first `named` markers. `tissue_rad` is the amplitude of a rotation
    of the sensor relative to the bone, at 2 Hz.
    """
    rng = np.random.default_rng(5)
    t_ref = np.arange(start_s, start_s + seconds, 1 / 120)
    t_imu = np.arange(start_s + 0.003, start_s + seconds, 0.01)
    q_ref, q_imu = (orientations(t * (not still)) for t in (t_ref, t_imu))
    markers = rotation.rotate(q_ref[:, None], np.array(PLACES))
    markers = markers + rng.normal(scale=2e-4, size=markers.shape)
    q_imu = rotation.multiply(q_imu, rotation.conjugate(MOUNT))
    wobble = np.outer(tissue_rad * np.sin(4 * np.pi * t_imu), [0.6, 0.8, 0.0])
    q_imu = rotation.multiply(q_imu, rotation.exp(wobble))
    notices, at = [], 0
    for k, t in enumerate(t_imu):
        while at < len(t_ref) and t_ref[at] <= t:
            t_ns = round(t_ref[at] * 1e9)
            layout = MocapLayout(NAMES[:named], ())
            seen = markers[at, :named]
            frame = MocapFrame(t_ns, at, None, layout, seen, np.zeros((0, 3)), np.zeros((0, 4)))
            monitor.add_mocap(t_ns, frame)
            at += 1
        stamp_ns = round(t * 1e9 + lag_ms * MS)
        monitor.add_sample("S1", stamp_ns, as_quaternion(q_imu[k].tolist()), epoch)
        notices += [TimedNotice(t, notice) for notice in monitor.step(round(t * 1e9))]
    return notices


def test_lag_is_estimated_during_movement() -> None:
    monitor = LagMonitor(CHAIN, CALIBRATION)
    assert lag_payload(monitor.health()["S1"])["lag_source"] == "calibration"
    assert play(monitor, 16.0, 7.3) == []
    found = lag_payload(monitor.health()["S1"])
    assert found["lag_source"] == "calibration"
    assert found["lag_ms"] == 2.0  # the lag of the calibration stays in use
    assert (found["lag_sigma_ms"], found["lag_found_by"]) == (0.2, "plate and movement")
    assert found["tracked_ms"] == pytest.approx(7.3, abs=0.1)
    assert found["tracked_refused"] is None
    kept = LagMonitor(CHAIN, replace(CALIBRATION, notes=("new",)), monitor)
    assert lag_payload(kept.health()["S1"])["tracked_ms"] == found["tracked_ms"]


def test_orientations_of_overlapping_windows_equal_those_fitted_anew() -> None:
    """Orientations that were fitted for earlier windows equal a new fit of the stored frames."""
    monitor = LagMonitor(CHAIN, CALIBRATION)
    play(monitor, 24.0, 4.0)
    track = monitor._tracks["thigh"]
    # The earliest frames have been discarded.
    rows = [row for row in monitor._frames if row[0] <= track.end_ns]
    seen = np.stack([frame.markers for _, frame in rows])
    assert len(rows) > 1000
    assert track.t_ns[-len(rows) :].tolist() == [t_ns for t_ns, _ in rows]
    assert np.array_equal(track.q[-len(rows) :], rigid_fit(np.array(PLACES), seen)[0])


def test_lag_step_is_reported_once_within_20_s_as_a_calibration_warning() -> None:
    monitor = LagMonitor(CHAIN, CALIBRATION)
    assert play(monitor, 20.0, 4.0) == []
    notices = play(monitor, 30.0, 7.0, start_s=20.0)
    assert [(one.notice.kind, one.notice.id) for one in notices] == [("calibration", "S1")]
    assert notices[0].t_s < 40.0
    assert notices[0].notice.data["step_ms"] == pytest.approx(3.0, abs=0.3)
    assert lag_payload(monitor.health()["S1"])["tracked_ms"] == pytest.approx(7.0, abs=0.1)


def test_clock_restart_changes_the_lag_by_less_than_its_standard_deviation() -> None:
    monitor = LagMonitor(CHAIN, CALIBRATION)
    play(monitor, 16.0, 4.0)
    before = lag_payload(monitor.health()["S1"])
    assert play(monitor, 16.0, 4.0, start_s=16.0, epoch=1) == []
    after = lag_payload(monitor.health()["S1"])
    assert abs(float(str(after["tracked_ms"])) - float(str(before["tracked_ms"]))) <= float(
        str(before["tracked_sigma_ms"])
    )
    # After the restart, the lag differs by less than the accuracy of a clock. This is no step.
    assert play(monitor, 16.0, 4.8, start_s=32.0, epoch=2) == []
    assert lag_payload(monitor.health()["S1"])["tracked_ms"] == pytest.approx(4.8, abs=0.1)


def test_standing_still_gives_no_estimate_and_the_remedy() -> None:
    monitor = LagMonitor(CHAIN, CALIBRATION)
    play(monitor, 12.0, 4.0, still=True)
    found = lag_payload(monitor.health()["S1"])
    assert found["lag_source"] == "calibration"
    assert found["lag_ms"] == 2.0
    assert "move faster" in str(found["tracked_refused"])


def test_a_low_r2_on_soft_tissue_is_no_alarm() -> None:
    monitor = LagMonitor(CHAIN, CALIBRATION)
    play(monitor, 12.0, 4.0, tissue_rad=0.2)
    refused = str(lag_payload(monitor.health()["S1"])["tracked_refused"])
    assert refused.startswith("R² 0.")
    assert refused.endswith("normal on soft tissue, the lag in use is not changed")
    assert "check" not in refused


@pytest.mark.parametrize("named", [0, 1, 2])
def test_stream_without_markers_of_the_segment_gives_no_estimate(named: int) -> None:
    monitor = LagMonitor(CHAIN, CALIBRATION)
    play(monitor, 14, 5.0, named=named)
    health = lag_payload(monitor.health()["S1"])
    assert health["tracked_ms"] is None
    assert "no gapless stretch of data" in str(health["tracked_refused"])


def test_configured_lag_is_used_and_only_checked_by_the_estimate() -> None:
    monitor = LagMonitor(CHAIN, CALIBRATION, known={"S1": KnownLag(1.0 * MS, 0.05 * MS)})
    notices = play(monitor, 19.0, 4.0)
    assert [one.notice.kind for one in notices] == ["clock"]
    assert "standard deviations apart" in notices[0].notice.text
    assert lag_payload(monitor.health()["S1"])["lag_source"] == "configured"
    assert lag_payload(monitor.health()["S1"])["lag_ms"] == 1.0


def test_without_clusters_nothing_is_estimated() -> None:
    monitor = LagMonitor(CHAIN, None)
    assert play(monitor, 11.0, 4.0) == []
    assert lag_payload(monitor.health()["S1"])["lag_source"] == "none"
