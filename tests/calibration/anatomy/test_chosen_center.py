"""Joint centers by the estimators that rig.toml can select, compared with the true geometry."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import TYPE_CHECKING, get_args

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration import CalibrationError, CalibrationSettings, CenterMethod
from jointfit_daemon.calibration.anatomy import (
    CenterChoice,
    ClusterTrack,
    JointCenter,
    find_anatomy,
    static_cluster,
    track_clusters,
)
from jointfit_daemon.calibration.phases._inertial_rotations import inertial_rotations
from jointfit_daemon.calibration.phases._static_pose import fit_static
from jointfit_daemon.calibration.registration import sensor_at
from jointfit_daemon.kinematics import rotation
from tests.calibration.anatomy.test_segment_frames import truth
from tests.calibration.synthetic_limb import (
    CHAIN,
    MARKERS,
    SETTINGS,
    Imperfections,
    Subject,
    motion,
    record,
)

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

SUBJECT = Subject(5, flaws=Imperfections(heading_deg=0.0))
CHOICES: tuple[CenterMethod, ...] = get_args(CenterMethod)


@cache
def recorded() -> tuple[dict[str, ClusterTrack], dict[str, Array]]:
    """Return the poses of all body parts, and the rotations of the segments from their IMUs."""
    static = record(SUBJECT, motion(SUBJECT, 6.0, 200.0, still=True), 1)
    moving = record(SUBJECT, motion(SUBJECT, 15.0, 200.0), 2)
    assert static.optical is not None
    assert moving.optical is not None
    settings = CalibrationSettings(markers=MARKERS)
    clusters = {part: static_cluster(static.optical, part, settings) for part in MARKERS}
    tracks = track_clusters(moving.optical, clusters)
    raw = {name: sensor_at(track, moving.optical.t_ns) for name, track in moving.sensors.items()}
    return tracks, inertial_rotations(CHAIN, raw, fit_static(static, SETTINGS, CHAIN), None)


def center_of(joint: str, method: CenterMethod) -> JointCenter:
    tracks, turned = recorded()
    found = find_anatomy(CHAIN, tracks, CenterChoice({joint: method}, turned)).joints[joint]
    assert found is not None
    assert found.fit is not None
    assert found.fit.method == method
    assert "orientation_inconsistent" not in found.fit.flags
    return found


@pytest.mark.parametrize("method", CHOICES)
def test_every_estimator_finds_the_knee_and_its_axis(method: CenterMethod) -> None:
    found = center_of("knee", method)
    fit = found.fit
    assert fit is not None
    assert fit.axis is not None
    across = np.eye(3) - np.outer(fit.axis, fit.axis)
    assert np.linalg.norm(across @ (fit.center - truth(SUBJECT)["knee"])) < 0.004
    assert np.linalg.norm(found.center - truth(SUBJECT)["knee"]) < 0.01
    assert fit.leverage is not None
    assert np.abs(fit.leverage @ fit.axis).max() < 1e-6 * np.abs(fit.leverage).max()

    # internal rotation of 0.1 per unit of flexion tilts the axis of this knee by up to 6 degrees
    right = Rotation.from_rotvec([0.0, 0.0, SUBJECT.facing]).apply([1.0, 0.0, 0.0])
    assert abs(fit.axis @ right) > np.cos(np.deg2rad(6.0))
    assert fit.axis_sd is not None
    assert np.deg2rad(0.005) < fit.axis_sd < np.deg2rad(1.0)


def test_three_frames_of_a_live_track_weight_their_noise_by_the_residuals_of_the_cameras() -> None:
    tracks, turned = recorded()
    shank, choice = tracks["shank"], CenterChoice({"knee": "three_frames"}, turned)
    relative = rotation.multiply(rotation.conjugate(tracks["thigh"].q), shank.q)
    angle = 2.0 * np.arccos(np.clip(np.abs(relative[:, 0]), 0.0, 1.0))
    part = (angle - np.nanmin(angle)) / np.ptp(angle[np.isfinite(angle)])
    # These frames are close to the first, the middle or the last position.
    used = np.abs(part[:, None] - [0.0, 0.5, 1.0]).min(axis=1) < 0.1
    used = np.tile(used[:, None], shank.points.shape[1])

    def predicted_variance(residuals: Array | None) -> float:
        moved = tracks | {"shank": replace(shank, residuals=residuals)}
        found = find_anatomy(CHAIN, moved, choice).joints["knee"]
        assert found is not None
        assert found.fit is not None
        return float(np.trace(found.fit.covariance))

    plain = predicted_variance(None)
    assert predicted_variance(np.full_like(shank.points[..., 0], 3e-4)) == pytest.approx(plain)
    assert predicted_variance(np.where(used, 2e-4, 6e-4)) < 0.8 * plain
    # here the used frames have the larger residuals, so the variance does not decrease
    assert predicted_variance(np.where(used, 6e-4, 2e-4)) > 0.99 * plain


def test_an_ankle_uses_the_angle_of_the_shank_if_the_foot_has_no_imu() -> None:
    found = center_of("ankle", "oriented")
    assert np.linalg.norm(found.center - truth(SUBJECT)["ankle"]) < 0.01


@pytest.mark.parametrize("method", ["sara", "geometric", "oriented", "grid", "three_frames"])
def test_a_hip_moved_about_two_axes_is_refused_by_estimators_of_one_axis(
    method: CenterMethod,
) -> None:
    tracks, turned = recorded()
    circles = slice(-5 * 120, None)
    last = {
        name: replace(
            track,
            t_ns=track.t_ns[circles],
            q=track.q[circles],
            p=track.p[circles],
            points=track.points[circles],
            rms=track.rms[circles],
        )
        for name, track in tracks.items()
    }
    choice = CenterChoice({"hip": method}, {name: q[circles] for name, q in turned.items()})
    with pytest.raises(CalibrationError, match=rf"hip: center_method {method}: .*one axis"):
        find_anatomy(CHAIN, last, choice)


def test_a_hip_moved_about_two_axes_is_a_point_of_both_bodies() -> None:
    """SCoRE finds a center, and no axis, if the hip moves about two axes."""
    found = center_of("hip", "score")
    assert found.fit is not None
    assert found.fit.axis is None
    assert np.linalg.norm(found.center - truth(SUBJECT)["hip"]) < 0.004


def test_a_joint_seen_too_rarely_is_refused() -> None:
    tracks, turned = recorded()
    foot = tracks["foot"]
    hidden = replace(foot, q=foot.q * np.nan, points=foot.points * np.nan)
    with pytest.raises(CalibrationError, match="ankle: center_method score: 0 frames"):
        find_anatomy(CHAIN, tracks | {"foot": hidden}, CenterChoice({"ankle": "score"}, turned))


def test_rotations_from_imus_equal_those_from_markers() -> None:
    tracks, turned = recorded()
    for segment in CHAIN.segments:
        q, other = turned[segment], tracks[segment].q
        known = np.isfinite(q).all(axis=1) & np.isfinite(other).all(axis=1)
        assert known.mean() > 0.95
        gap = Rotation.from_quat(q[known], scalar_first=True).inv() * Rotation.from_quat(
            other[known], scalar_first=True
        )
        assert np.degrees(np.median(gap.magnitude())) < 0.5


@pytest.mark.parametrize("method", ["grid", "three_frames"])
def test_marker_that_contradicts_the_others_is_flagged_by_its_name(method: CenterMethod) -> None:
    tracks, turned = recorded()
    points = tracks["shank"].points.copy()
    points[:, 1] += rotation.rotate(tracks["thigh"].q, np.array([0.0, 0.12, 0.05]))
    shifted = {**tracks, "shank": replace(tracks["shank"], points=points)}
    found = find_anatomy(CHAIN, shifted, CenterChoice({"knee": method}, turned)).joints["knee"]
    assert found is not None
    assert found.fit is not None
    assert [flag for flag in found.fit.flags if ":" in flag] == ["marker_off:shank1"]
