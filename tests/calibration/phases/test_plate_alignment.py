"""Alignments of sensor worlds from a rotated plate are correct, or refused with the reason."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration import CalibrationError, CalibrationSettings
from jointfit_daemon.calibration.phases import PlateAlignment, fit_plate_alignment
from tests.calibration.synthetic_limb import (
    SETTINGS,
    Imperfections,
    Subject,
    optical_track,
    plate_trial,
)

PLATE = np.array([[0.1, 0, 0], [-0.1, 0.05, 0], [0, -0.1, 0.03], [0.03, 0.08, 0.05]])


def errors_deg(found: PlateAlignment, subject: Subject) -> list[float]:
    return [
        float(
            np.degrees(
                (world.inv() * Rotation.from_quat(found.world(s), scalar_first=True)).magnitude()
            )
        )
        for s, world in subject.worlds().items()
    ]


def test_worlds_up_to_90_degrees_apart_are_aligned_in_spite_of_a_lag() -> None:
    subject = Subject(5, flaws=Imperfections(sensor_deg=0.5, lag_s=0.02, occluded=0.05))
    found = fit_plate_alignment(plate_trial(subject), SETTINGS)
    assert max(errors_deg(found, subject)) < 0.3
    for item in found.sensors.values():
        assert item.quality.kind == "full"
        assert item.quality.kappa < 0.95
        assert item.quality.lag_ns == pytest.approx(20e6, abs=2e6)


def test_given_lag_is_used_by_the_plate_alignment() -> None:
    subject = Subject(5, flaws=Imperfections(lag_s=0.05))
    lags = dict.fromkeys(subject.worlds(), 50_000_000)
    found = fit_plate_alignment(plate_trial(subject), SETTINGS, lag_ns=lags)
    assert max(errors_deg(found, subject)) < 0.1


def test_plate_of_markers_aligns_like_a_rigid_body() -> None:
    subject = Subject(6)
    trial = plate_trial(subject)
    assert trial.optical is not None
    turned = Rotation.from_quat(trial.optical.body_orientations[:, 0], scalar_first=True)
    positions = np.asarray(np.stack([turned.apply(m) for m in PLATE], axis=1), dtype=np.float64)
    positions[::7, 2] = np.nan
    names = ("P1", "P2", "P3", "P4")
    optical = optical_track(trial.optical.t_ns.astype(np.float64) / 1e9, positions, names)
    settings = CalibrationSettings(markers={"plate": names})
    found = fit_plate_alignment(replace(trial, optical=optical), settings)
    assert max(errors_deg(found, subject)) < 0.2


def test_rotation_about_one_horizontal_axis_yields_the_heading_only_and_reports_it() -> None:
    subject = Subject(7)
    found = fit_plate_alignment(plate_trial(subject, axes=1), SETTINGS)
    assert {item.quality.kind for item in found.sensors.values()} == {"heading"}
    assert max(errors_deg(found, subject)) < 1.0
    assert any("only the heading was aligned" in note for note in found.notes)


def test_an_unknown_plate_is_refused_with_the_nearest_spelling() -> None:
    settings = CalibrationSettings(plate="Plaet")
    with pytest.raises(CalibrationError, match="did you mean 'Plate'"):
        fit_plate_alignment(plate_trial(Subject(), 8.0), settings)


def test_no_plate_and_no_movement_are_refused() -> None:
    with pytest.raises(CalibrationError, match="no plate"):
        fit_plate_alignment(plate_trial(Subject(), 8.0), CalibrationSettings())
    with pytest.raises(CalibrationError, match=r"S1.*S2.*S3.*S4"):
        fit_plate_alignment(plate_trial(Subject(), 8.0, axes=0), SETTINGS)


def test_a_sensor_that_came_loose_is_named() -> None:
    subject = Subject(8)
    trial = plate_trial(subject)
    track = trial.sensors["S3"]
    t = np.linspace(0, 20, len(track.t_ns))
    loose = Rotation.from_rotvec(np.stack((0.6 * np.sin(t), 0.5 * np.cos(1.7 * t), 0 * t), axis=1))
    q = Rotation.from_quat(track.q_world_sensor, scalar_first=True) * loose
    sensors = {**trial.sensors, "S3": replace(track, q_world_sensor=q.as_quat(scalar_first=True))}
    with pytest.raises(CalibrationError) as caught:
        fit_plate_alignment(replace(trial, sensors=sensors), SETTINGS)
    assert [reason[:2] for reason in caught.value.reasons] == ["S3"]


def test_json_is_exact() -> None:
    found = fit_plate_alignment(plate_trial(Subject(), 12.0), SETTINGS)
    assert PlateAlignment.from_dict(json.loads(json.dumps(found.to_dict()))) == found
