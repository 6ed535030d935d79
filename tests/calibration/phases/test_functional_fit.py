"""Functional calibrations agree with the simulated geometry, or are refused with the reason."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from jointfit_daemon.calibration import CalibrationError, CalibrationTrial
from jointfit_daemon.calibration.phases import (
    fit_calibration,
    fit_plate_alignment,
    fit_static,
    with_new_static,
)
from jointfit_daemon.calibration.phases._acceptance import compare_calibrations
from jointfit_daemon.calibration.phases._static_pose import fit_static_only
from jointfit_daemon.calibration.record import trials_digest
from jointfit_daemon.calibration.record._content_check import content_faults
from jointfit_daemon.calibration.soft_tissue import METHODS
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import Calibration, CalibrationSchemaError
from jointfit_daemon.outputs.payloads._quality_units import quality_payload
from tests.calibration.synthetic_limb import (
    CHAIN,
    LENGTH,
    LOCAL,
    MARKERS,
    OWNER,
    SETTINGS,
    Imperfections,
    Subject,
    motion,
    plate_trial,
    record,
    static_and_functional,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

WORN = Imperfections(
    sensor_deg=0.3, tissue_deg=4.0, skin_m=0.005, lag_s=0.015, occluded=0.05, heading_deg=90.0
)


@pytest.fixture(scope="module")
def clean() -> tuple[Subject, Calibration]:
    subject = Subject(11)
    static, functional, _ = static_and_functional(subject, 24.0)
    alignment = fit_plate_alignment(plate_trial(subject), SETTINGS)
    found = fit_calibration(static, functional, alignment, SETTINGS, CHAIN, software="1.2")
    return subject, replace(found, created_utc="2026-01-01")


def errors_deg(subject: Subject, calibration: Calibration, sensor: str) -> NDArray[np.float64]:
    """Return angles between a sensor's calibrated orientation and the bone, in a new movement."""
    moving = motion(subject, 20.0, 400.0)
    track = record(subject, moving, 9, cameras=False).sensors[sensor]
    item = calibration.sensor[sensor]
    said = rotation.multiply(
        rotation.multiply(item.q_optical_world, track.q_world_sensor), item.q_sensor_segment
    )
    t = (track.t_ns - round(subject.flaws.lag_s * 1e9)) * 1e-9
    bone = Slerp(moving.t_s, moving.q[OWNER[sensor]])(t)
    gap = bone.inv() * Rotation.from_quat(said, scalar_first=True)
    return np.asarray(np.degrees(gap.magnitude()))


def test_fitted_sensors_reproduce_the_bones(clean: tuple[Subject, Calibration]) -> None:
    subject, calibration = clean
    for sensor in OWNER:
        assert np.median(errors_deg(subject, calibration, sensor)) < 2.5
    for segment, length in LENGTH.items():
        assert calibration.segment[segment].length == pytest.approx(length, abs=0.004)
    assert calibration.flags == ()


def test_json_is_exact_through_text(clean: tuple[Subject, Calibration]) -> None:
    calibration = clean[1]
    text = json.dumps(calibration.to_dict(), allow_nan=False)
    again = Calibration.from_dict(json.loads(text))
    assert again == calibration
    assert content_faults(again) == []
    assert json.dumps(again.to_dict(), allow_nan=False) == text
    assert (again.software, again.created_utc) == ("1.2", "2026-01-01")
    assert len(again.digest) == 64


@pytest.fixture(scope="module")
def short_trials() -> tuple[CalibrationTrial, CalibrationTrial]:
    """Return a static and a functional trial without heading errors of the sensor worlds."""
    subject = Subject(11, flaws=Imperfections(heading_deg=0.0))
    static, functional, _ = static_and_functional(subject, 12.0)
    return static, functional


@pytest.fixture(scope="module")
def regressed(short_trials: tuple[CalibrationTrial, CalibrationTrial]) -> Calibration:
    """Return a calibration by regression, with a knee center from markers and IMUs."""
    settings = replace(
        SETTINGS, method="patent12", joint_center_methods={"knee": "oriented", "hip": "score"}
    )
    return fit_calibration(*short_trials, None, settings, CHAIN)


def test_rotations_and_regression_coefficients_in_use_are_published(
    clean: tuple[Subject, Calibration], regressed: Calibration
) -> None:
    published = clean[1].quality["sensors"]
    for name, item in clean[1].sensor.items():
        assert tuple(published[name]["q_sensor_segment"]) == item.q_sensor_segment
    assert "regression" not in clean[1].quality  # its method is `anchored`

    found = regressed
    for segment, figures in found.quality["regression"].items():
        stored = found.segment[segment].models[f"{'+'.join(figures['sensors'])}|"].to_dict()
        assert figures["stored"] == [list(row) for row in stored["coefficients"]]
        assert figures["verified"] != figures["stored"]


def test_centers_are_published_in_coordinates_of_both_segments(
    clean: tuple[Subject, Calibration],
) -> None:
    centers = clean[1].quality["anatomy"]["centers"]
    assert centers.keys() == {"hip", "knee", "ankle"}
    for joint, above, below in (("hip", "pelvis", "thigh"), ("knee", "thigh", "shank")):
        found = centers[joint]
        assert found["method"] == "sphere"
        assert found["frames"] >= found["effective_frames"] > 100
        assert 0.0 < found["noise_error_m"] < 0.001 < found["predicted_error_m"]
        assert found["segments"].keys() == {above, below}

        # The origin of the distal segment is the joint center. The origin of the published
        # coordinates is the mean of the markers.
        in_distal = found["segments"][below]
        expected = -np.mean(LOCAL[below], axis=0)
        assert np.linalg.norm(np.subtract(in_distal["center_m"], expected)) < 0.015
        for side in found["segments"].values():
            covariance = np.array(side["covariance_m2"])
            assert np.linalg.eigvalsh(covariance)[0] > -1e-12
            assert np.trace(covariance) == pytest.approx(
                (3 - len(side["unseen"])) * found["predicted_error_m"] ** 2
            )

    # At a hinge, the position along the axis is unobservable. The axis points to the right.
    knee = centers["knee"]["segments"]["thigh"]
    assert knee["unseen"] == [knee["axis"]]
    assert abs(knee["axis"][0]) > 0.99
    assert 0.0 < centers["knee"]["axis_sd_rad"] < 0.01
    assert "axis_sd_rad" not in centers["hip"]
    told = quality_payload(clean[1].quality)["anatomy"]["centers"]["knee"]
    assert told["axis_sd_deg"] == pytest.approx(np.degrees(centers["knee"]["axis_sd_rad"]), 1e-3)


def test_the_configured_estimators_determine_the_stored_centers(regressed: Calibration) -> None:
    centers = regressed.quality["anatomy"]["centers"]
    assert [centers[joint]["method"] for joint in ("hip", "knee", "ankle")] == [
        "score", "oriented", "sphere",
    ]  # fmt: skip
    assert regressed.segment["thigh"].length == pytest.approx(LENGTH["thigh"], abs=0.008)


@pytest.mark.parametrize("damage", [{"schema": 99}, {"sensor": {"S1": {}}}, {"segments": None}])
def test_a_json_of_something_else_is_refused(
    clean: tuple[Subject, Calibration], damage: dict[str, object]
) -> None:
    with pytest.raises(CalibrationSchemaError):
        Calibration.from_dict({**clean[1].to_dict(), **damage})


def test_every_set_of_working_sensors_has_a_model(clean: tuple[Subject, Calibration]) -> None:
    assert set(clean[1].segment["thigh"].models) == {
        f"{alive}|{near}" for alive in ("S1+S2", "S1", "S2") for near in ("", "S3+S4", "S3", "S4")
    }


def test_correction_has_smaller_errors_than_the_mean_and_is_fitted_in_three_seconds() -> None:
    subject = Subject(12, flaws=WORN)
    static, functional, _ = static_and_functional(subject, 40.0)
    alignment = fit_plate_alignment(plate_trial(subject), SETTINGS)
    began = time.process_time()
    found = fit_calibration(static, functional, alignment, SETTINGS, CHAIN)
    assert time.process_time() - began < 15.0  # loose limit; three seconds on an idle machine
    figures = found.quality["holdout"]
    for segment in CHAIN.segments:
        of = figures["segments"][segment]
        assert set(of) == {*METHODS, "sensors"}
        assert of["anchored"] < 0.85 * of["mean"]
        assert np.rad2deg(of["anchored"]) < 5.0
    assert np.rad2deg(figures["flexion"]["knee"]["anchored"]) < 3.0
    for sensor in OWNER:
        assert found.lag_ns[sensor] == pytest.approx(15e6, abs=0.5e6)


def test_calibration_without_alignment_reports_it_and_names_rotated_worlds() -> None:
    subject = Subject(11)
    static, functional, _ = static_and_functional(subject, 24.0)
    found = fit_calibration(static, functional, None, replace(SETTINGS, method="mean"), CHAIN)
    assert "headings_from_static" in found.flags
    worlds = {s: np.degrees(w.as_rotvec()[2]) for s, w in subject.worlds().items()}
    turned = {s for s, angle in worlds.items() if abs(angle) > 35}
    assert turned
    assert {note[:2] for note in found.notes if "seems rotated" in note} >= turned


def test_all_missing_inputs_of_a_calibration_are_named_together() -> None:
    static, functional, _ = static_and_functional(Subject(1), 12.0)
    sensors = {s: track for s, track in static.sensors.items() if s != "S2"}
    settings = replace(SETTINGS, markers={**MARKERS, "thigh": ("thigh0", "thigh1", "thihg2")})
    with pytest.raises(CalibrationError) as caught:
        fit_static(replace(static, sensors=sensors), settings, CHAIN)
    text = str(caught.value)
    assert "S2" in text
    assert "did you mean 'thigh2'" in text
    pose = fit_static(replace(static, optical=None), SETTINGS, CHAIN)
    with pytest.raises(CalibrationError, match=r"thigh: no markers.*shank: no markers"):
        fit_calibration(pose, functional, None, SETTINGS, CHAIN)
    with pytest.raises(CalibrationError, match="optical system"):
        fit_calibration(static, replace(functional, optical=None), None, SETTINGS, CHAIN)


def test_a_pose_that_moved_or_was_short_is_refused() -> None:
    subject = Subject(1)
    moving = record(subject, motion(subject, 10.0, 400.0), 1)
    with pytest.raises(CalibrationError, match="S1: orientation scatters"):
        fit_static(moving, SETTINGS, CHAIN)
    short = record(subject, motion(subject, 1.0, 400.0, still=True), 1)
    with pytest.raises(CalibrationError, match=r"static pose of 1\.0 s"):
        fit_static(short, SETTINGS, CHAIN)


def test_hidden_markers_are_refused_with_their_share() -> None:
    static, functional, _ = static_and_functional(Subject(1), 12.0)
    assert functional.optical is not None
    positions = functional.optical.positions.copy()
    column = functional.optical.markers.index("shank0")
    positions[::3, column : column + 2] = np.nan
    positions[1::3, column : column + 2] = np.nan
    hidden = replace(functional, optical=replace(functional.optical, positions=positions))
    with pytest.raises(
        CalibrationError, match="shank: at least three markers were visible in 33 %"
    ):
        fit_calibration(static, hidden, None, SETTINGS, CHAIN)


def test_redonning_changes_biases_only(clean: tuple[Subject, Calibration]) -> None:
    subject, calibration = clean
    again = replace(subject, facing=subject.facing + 0.8)
    standing = record(again, motion(again, 6.0, 400.0, still=True), 5)
    remounted = Rotation.from_euler("xyz", [20, -30, 40], degrees=True)
    sensors = {
        name: replace(
            track,
            q_world_sensor=(
                Rotation.from_quat(track.q_world_sensor, scalar_first=True) * remounted
            ).as_quat(scalar_first=True),
        )
        for name, track in standing.sensors.items()
    }
    pose = fit_static(replace(standing, sensors=sensors), SETTINGS, CHAIN)
    found = with_new_static(calibration, pose)
    for name, item in found.sensor.items():
        old = calibration.sensor[name]
        wanted = rotation.multiply(
            rotation.conjugate(remounted.as_quat(scalar_first=True)), old.q_sensor_segment
        )
        assert rotation.angle_between(item.q_sensor_segment, wanted) < np.radians(0.3)
    parts = ("segment", "joint", "method", "flags", "clusters", "digest")
    assert all(getattr(found, part) == getattr(calibration, part) for part in parts)


def test_redonning_without_cameras_assumes_the_same_pose(
    clean: tuple[Subject, Calibration],
) -> None:
    subject, calibration = clean
    standing = record(subject, motion(subject, 6.0, 400.0, still=True), 5, cameras=False)
    found = with_new_static(calibration, fit_static(standing, SETTINGS, CHAIN))
    assert "same_pose_assumed" in found.flags
    for name, item in found.sensor.items():
        old = calibration.sensor[name].q_sensor_segment
        assert rotation.angle_between(item.q_sensor_segment, old) < np.radians(0.2)


def test_without_cameras_the_static_pose_is_the_identity() -> None:
    subject = Subject(2)
    standing = record(subject, motion(subject, 6.0, 400.0, still=True), 1, cameras=False)
    pose = fit_static(standing, SETTINGS, CHAIN)
    found = fit_static_only(pose, None, replace(CHAIN, lengths=(0.42, None)))
    assert found.flags == ("headings_from_static",)
    assert found.segment["thigh"].length == 0.42
    assert found.segment["shank"].length is None
    for name, item in found.sensor.items():
        q = rotation.multiply(standing.sensors[name].q_world_sensor, item.q_sensor_segment)
        assert np.max(rotation.angle_between(q, rotation.IDENTITY)) < np.radians(0.5)
    assert Calibration.from_dict(json.loads(json.dumps(found.to_dict()))) == found
    assert content_faults(found) == []


def test_worse_or_incomplete_calibration_is_not_preferred(
    clean: tuple[Subject, Calibration],
) -> None:
    old = clean[1]
    assert compare_calibrations(old, None).better
    assert compare_calibrations(old, old).better
    figures = json.loads(json.dumps(old.quality))
    figures["holdout"]["segments"]["shank"]["anchored"] += np.radians(3.0)
    verdict = compare_calibrations(replace(old, quality=figures), old)
    assert not verdict.better
    assert "shank: orientation error" in verdict.reason
    assert compare_calibrations(old, replace(old, quality=figures)).better
    blind = replace(old, quality={"static": {}})
    assert not compare_calibrations(blind, old).better
    assert not compare_calibrations(replace(old, flags=("headings_from_static",)), old).better
    assert compare_calibrations(blind, replace(old, joints=("a", "b", "c"))).better


def test_digest_differs_between_trials(
    short_trials: tuple[CalibrationTrial, CalibrationTrial], regressed: Calibration
) -> None:
    static, functional = short_trials
    track = functional.sensors["S1"]
    q = track.q_world_sensor.copy()
    q[5, 0] += 1e-9
    other = replace(
        functional, sensors={**functional.sensors, "S1": replace(track, q_world_sensor=q)}
    )
    assert trials_digest(static, functional) == regressed.digest
    assert trials_digest(static, other) != regressed.digest
