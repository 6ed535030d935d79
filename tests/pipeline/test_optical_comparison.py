"""The optical reference, and the differences of the IMUs from it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from jointfit_daemon.calibration.phases import fit_calibration
from jointfit_daemon.model import (
    FrameFlag,
    FusionMode,
    JointState,
    LimbState,
    MocapFrame,
    MocapLayout,
    OpticalState,
    SegmentState,
    SyncState,
)
from jointfit_daemon.pipeline._optical_comparison import OpticalComparison, RunningRms
from tests.calibration.synthetic_limb import (
    CHAIN,
    LENGTH,
    SETTINGS,
    Imperfections,
    Motion,
    Subject,
    motion,
    record,
    static_and_functional,
)

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Vector

SUBJECT = Subject(11, flaws=Imperfections(marker_m=0.00002))
RATE_HZ, CAMERA_HZ = 100, 120


@cache
def calibration() -> Calibration:
    static, functional, _ = static_and_functional(SUBJECT, 30.0)
    return fit_calibration(static, functional, None, SETTINGS, CHAIN)


@cache
def truth() -> Motion:
    return motion(SUBJECT, 15.0, 400.0)


@cache
def camera_frames() -> list[tuple[int, MocapFrame]]:
    optical = record(SUBJECT, truth(), 3, sensors=False).optical
    assert optical is not None
    layout = MocapLayout(optical.markers, ())
    none = np.zeros((0, 3))
    return [
        (int(t_ns), MocapFrame(int(t_ns), k, None, layout, row, none, np.zeros((0, 4))))
        for k, (t_ns, row) in enumerate(zip(optical.t_ns, optical.positions, strict=True))
    ]


def vector(point: np.ndarray) -> Vector:
    x, y, z = point.tolist()
    return (x, y, z)


def limb_states(shank_error: Rotation | None = None) -> list[LimbState]:
    """Return states with the true bones; `shank_error` rotates the shank in its own axes."""
    moving, wrong = truth(), shank_error or Rotation.identity()
    t = np.arange(moving.t_s[0], moving.t_s[-1], 1 / RATE_HZ)
    # In the calibration, the axes of a segment differ from the axes of its bone by a constant
    # rotation.
    thigh, shank = (Slerp(moving.t_s, moving.q[name])(t) for name in ("thigh", "shank"))
    thigh, shank = thigh * axes("thigh"), shank * axes("shank") * wrong
    hips = np.stack([np.interp(t, moving.t_s, moving.p["thigh"][:, k]) for k in range(3)], axis=1)
    knees = np.stack([np.interp(t, moving.t_s, moving.p["shank"][:, k]) for k in range(3)], axis=1)
    states = []
    for k, t_s in enumerate(t):
        q = [tuple(r[k].as_quat(scalar_first=True).tolist()) for r in (thigh, shank)]
        segments = tuple(
            SegmentState(name, one, 0.01, group)
            for name, one, group in zip(CHAIN.segments, q, CHAIN.sensors, strict=True)
        )
        joints = (
            JointState("hip", vector(hips[k]), 0.0),
            JointState("knee", vector(knees[k]), 0.01),
            JointState("ankle", None, None),
        )
        t_ns = round(t_s * 1e9)
        state = LimbState(
            k + 1, t_ns, t_ns, FusionMode.IMU_AND_MOCAP, SyncState.LOCKED, (), segments, joints
        )
        states.append(state)
    return states


@cache
def axes(segment: str) -> Rotation:
    """Return the constant rotation from the bone of the subject to the segment of its calibration.

    The rotation is computed from the first camera frame, in which the subject stands, because the
    calibration may choose the axes of a segment.
    """
    comparison = OpticalComparison(CHAIN, calibration(), 1000.0)
    t_ns, frame = camera_frames()[0]
    comparison.add_frame(t_ns, frame, synced=True)
    state = LimbState(1, t_ns, t_ns, FusionMode.IMU, SyncState.LOCKED, (), (), ())
    empty = tuple(SegmentState(name, None, None, ()) for name in CHAIN.segments)
    nowhere = tuple(JointState(name, None, None) for name in CHAIN.joints)
    (seen,) = comparison.add_state(state._replace(segments=empty, joints=nowhere))
    q = next(one.q_world_segment for one in seen.segments if one.name == segment)
    assert q is not None
    return truth().q[segment][0].inv() * Rotation.from_quat(q, scalar_first=True)


def compare(
    states: list[LimbState],
    *,
    rate_hz: float = 1000.0,
    synced: bool = True,
    change: Callable[[MocapFrame], MocapFrame] = lambda frame: frame,
) -> list[OpticalState]:
    """Return the comparison of the states with camera frames that arrive 5 ms late."""
    comparison = OpticalComparison(CHAIN, calibration(), rate_hz)
    frames, out = iter(camera_frames()), []
    t_ns, frame = next(frames)
    for state in states:
        while t_ns <= state.t_ns - 5_000_000:
            comparison.add_frame(t_ns, change(frame), synced=synced)
            t_ns, frame = next(frames)
        out += comparison.add_state(state)
    return out


def rms_deg(values: list[float]) -> float:
    return math.degrees(math.sqrt(float(np.mean(np.square(values)))))


def test_optical_pose_follows_the_true_joint_centers_and_angles() -> None:
    seen, moving = compare(limb_states()), truth()
    for number, part in ((0, "thigh"), (1, "shank"), (2, "foot")):
        expected = np.stack(
            [
                np.interp([s.t_ns / 1e9 for s in seen], moving.t_s, moving.p[part][:, k])
                for k in range(3)
            ],
            axis=1,
        )
        found = np.array([s.joints[number].position for s in seen])
        assert np.sqrt(((found - expected) ** 2).sum(axis=1).mean()) < 0.003
    knee = np.array([s.joints[1].angles.flexion for s in seen if s.joints[1].angles])
    expected = np.interp([s.t_ns / 1e9 for s in seen], moving.t_s, moving.angles[:, 1])
    change = knee - knee[0] - (expected - expected[0])
    assert rms_deg(change.tolist()) < 0.5


def test_lengths_of_the_limb_agree_with_the_subject() -> None:
    for state in compare(limb_states())[::50]:
        hip, knee, ankle = (np.array(joint.position) for joint in state.joints)
        assert np.linalg.norm(hip - knee) == pytest.approx(LENGTH["thigh"], abs=0.005)
        assert np.linalg.norm(knee - ankle) == pytest.approx(LENGTH["shank"], abs=0.005)


def test_true_imus_have_no_residual_even_between_frames_in_fast_movement() -> None:
    seen = [s for s in compare(limb_states()) if s.segments[0].residual is not None]
    assert len(seen) > 14 * CAMERA_HZ
    for number in (0, 1):
        residuals = [s.segments[number].residual for s in seen]
        assert rms_deg([r for r in residuals if r is not None]) < 0.05


@pytest.mark.parametrize("error_deg", [-20.0, -3.0, 0.5, 12.0])
def test_residual_flexion_is_imu_minus_cameras(error_deg: float) -> None:
    wrong = Rotation.from_euler("x", error_deg, degrees=True)
    last = compare(limb_states(wrong)[:150])[-1]
    knee = last.joints[1]
    assert knee.residual is not None
    assert knee.residual_rms is not None
    # Knee flexion is a negative rotation about x.
    assert math.degrees(knee.residual.flexion) == pytest.approx(-error_deg, abs=0.5)
    assert math.degrees(knee.residual_rms.flexion) == pytest.approx(abs(error_deg), abs=0.5)
    shank = last.segments[1]
    assert shank.residual is not None
    assert math.degrees(shank.residual) == pytest.approx(abs(error_deg), abs=0.5)


def test_position_residual_needs_the_origin_from_the_cameras() -> None:
    states = limb_states()[:200]
    seen = compare(states)[-1]
    assert seen.joints[0].distance is None  # the origin is not compared with itself
    assert seen.joints[1].distance == pytest.approx(0.0, abs=0.005)
    for other in ({"mode": FusionMode.IMU}, {"flags": (FrameFlag.ORIGIN_FIXED,)}):
        seen = compare([state._replace(**other) for state in states])[-1]
        assert seen.joints[1].distance is None
        assert seen.segments[0].residual is not None


def hide(part: str, count: int) -> Callable[[MocapFrame], MocapFrame]:
    """Return a change that hides `count` markers of a body part."""

    def change(frame: MocapFrame) -> MocapFrame:
        markers = frame.markers.copy()
        named = [k for k, name in enumerate(frame.layout.markers) if name.startswith(part)]
        markers[named[:count]] = np.nan
        return replace(frame, markers=markers)

    return change


def test_hidden_segment_is_null_and_its_joints_come_from_the_neighbors() -> None:
    seen = compare(limb_states()[:200], change=hide("thigh", 2))[-1]
    thigh, shank = seen.segments
    assert thigh == ("thigh", None, None, None)
    assert shank.residual is not None
    hip, knee, _ = seen.joints
    assert hip.position is not None
    assert knee.position is not None
    assert hip.gap is None
    assert knee == knee._replace(gap=None, angles=None, inner=None, residual=None)
    assert compare(limb_states()[:200], change=hide("thigh", 1))[-1].segments[0].residual


@pytest.mark.parametrize("case", ["stamps", "clock", "held", "gap"])
def test_unsynchronized_or_held_frames_have_no_residual(case: str) -> None:
    states = limb_states()[:200]
    if case == "clock":
        states = [state._replace(sync=SyncState.SETTLING) for state in states]
    if case == "held":
        held = [tuple(segment._replace(used=()) for segment in state.segments) for state in states]
        states = [s._replace(segments=one) for s, one in zip(states, held, strict=True)]
    if case == "gap":
        states = states[::10]
    seen = compare(states, synced=case != "stamps")
    assert seen
    assert all(joint.residual is None for state in seen for joint in state.joints)
    assert all(segment.residual is None for state in seen for segment in state.segments)
    assert seen[-1].joints[1].angles is not None


@pytest.mark.parametrize(("rate_hz", "expected"), [(25.0, 25.0), (500.0, 120.0), (100.0, 100.0)])
def test_rate_is_limited(rate_hz: float, expected: float) -> None:
    seen = compare(limb_states(), rate_hz=rate_hz)
    assert len(seen) / (seen[-1].t_ns - seen[0].t_ns) * 1e9 == pytest.approx(expected, rel=0.02)


def test_nothing_is_compared_without_calibration_or_at_rate_0() -> None:
    (t_ns, frame), state = camera_frames()[0], limb_states()[10]
    other = replace(calibration(), segments=("thigh", "foot"))
    for known, rate_hz in ((None, 25.0), (calibration(), 0.0), (other, 25.0)):
        comparison = OpticalComparison(CHAIN, known, rate_hz)
        comparison.add_frame(t_ns, frame, synced=True)
        assert comparison.add_state(state) == []


def test_running_rms_forgets_within_its_time() -> None:
    rms, value = RunningRms(10.0), 0.0
    for k in range(300):
        value = rms.add(k * 100_000_000, 3.0)
    assert value == pytest.approx(3.0)
    for k in range(300, 600):
        value = rms.add(k * 100_000_000, 1.0)
    # After three time constants, the earlier value has the fraction exp(-3) of the weight.
    share = math.exp(-3.0)
    assert value == pytest.approx(math.sqrt(1.0 + 8.0 * share), rel=0.02)
