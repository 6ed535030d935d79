"""Jobs of the worker process: alignments, previous calibrations and results of the fits."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from jointfit_daemon.calibration import (
    AlignJob,
    CalibrationSettings,
    CalibrationTrial,
    FunctionalJob,
    SensorTrack,
    StaticJob,
)
from jointfit_daemon.calibration._quality import WorldQuality
from jointfit_daemon.calibration.phases import PlateAlignment, fit_static, run_job
from jointfit_daemon.calibration.phases._plate_alignment import AlignedSensor
from jointfit_daemon.calibration.phases._static_pose import fit_static_only
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import Calibration
from jointfit_daemon.model import Chain

SENSORS = ("S1", "S2", "S3", "S4")
CHAIN = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), (SENSORS[:2], SENSORS[2:]))
SETTINGS = CalibrationSettings(rigid_bodies={"thigh": "Thigh", "shank": "Shank"})
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
RNG = np.random.default_rng(7)


def about_z(angle: float) -> np.ndarray:
    return rotation.exp(np.array([0.0, 0.0, angle]))


def mounts() -> dict[str, np.ndarray]:
    """Return a random q_sensor_segment of every sensor."""
    return {name: rotation.exp(RNG.normal(size=3)) for name in SENSORS}


def worlds(angles: dict[str, float]) -> PlateAlignment:
    """Return an alignment in which the world of each sensor is rotated about the vertical.

    `angles` contains the rotation by sensor, rad.
    """
    return PlateAlignment(
        {
            name: AlignedSensor(
                as_quaternion(about_z(angle)),
                WorldQuality("full", 0.1, 0.01, 0.01, 4_000_000, None),
            )
            for name, angle in angles.items()
        }
    )


def standing(alignment: PlateAlignment, worn: dict[str, np.ndarray]) -> CalibrationTrial:
    """Return a static trial of five seconds with upright segments."""
    t_ns = np.arange(500, dtype=np.int64) * 10_000_000
    tracks = {}
    for name, mount in worn.items():
        q = said(alignment, worn, name, UPRIGHT)
        assert mount.shape == (4,)
        tracks[name] = SensorTrack(t_ns, np.tile(q, (len(t_ns), 1)))
    return CalibrationTrial(tracks, None)


def said(
    alignment: PlateAlignment, worn: dict[str, np.ndarray], name: str, q: np.ndarray
) -> np.ndarray:
    """Return the orientation that a sensor measures on a segment with the orientation `q`."""
    seen = rotation.multiply(rotation.conjugate(np.array(alignment.world(name))), q)
    return np.asarray(rotation.multiply(seen, rotation.conjugate(worn[name])))


def static_job(
    trial: CalibrationTrial, previous: Calibration, alignment: PlateAlignment | None
) -> Calibration:
    stored = None if alignment is None else alignment.to_dict()
    result = run_job(StaticJob(CHAIN, SETTINGS, trial, stored, previous))
    return Calibration.from_dict(result.to_dict()["calibration"])


def test_new_alignment_is_used_at_redonning() -> None:
    """All sensors were switched off and on, so their headings changed between the two poses."""
    before, worn = worlds(dict.fromkeys(SENSORS, 0.3)), mounts()
    pose = fit_static(standing(before, worn), SETTINGS, CHAIN)
    previous = fit_static_only(pose, before, CHAIN)
    now, worn = worlds({"S1": 2.0, "S2": -1.0, "S3": 0.5, "S4": 3.0}), mounts()
    found = static_job(standing(now, worn), previous, now)
    bent = rotation.exp(np.array([0.7, 0.4, 0.2]))
    for name, item in found.sensor.items():
        q = rotation.multiply(
            rotation.multiply(np.array(item.q_optical_world), said(now, worn, name, bent)),
            np.array(item.q_sensor_segment),
        )
        assert rotation.angle_between(q, bent) == pytest.approx(0.0, abs=1e-6), name
        assert item.lag_ns == 4_000_000


def test_without_a_new_alignment_the_worlds_are_unchanged() -> None:
    before, worn = worlds(dict.fromkeys(SENSORS, 0.3)), mounts()
    pose = fit_static(standing(before, worn), SETTINGS, CHAIN)
    previous = fit_static_only(pose, before, CHAIN)
    found = static_job(standing(before, mounts()), previous, None)
    assert {item.q_optical_world for item in found.sensor.values()} == {
        item.q_optical_world for item in previous.sensor.values()
    }


def test_published_rotations_are_those_after_redonning() -> None:
    room, worn = worlds(dict.fromkeys(SENSORS, 0.3)), mounts()
    previous = fit_static_only(fit_static(standing(room, worn), SETTINGS, CHAIN), room, CHAIN)
    turned = rotation.exp(np.array([0.2, 0.0, 0.0]))
    found = static_job(
        standing(room, {**worn, "S4": rotation.multiply(worn["S4"], turned)}), previous, None
    )
    for one in (previous, found):
        assert one.quality["sensors"] == {
            name: {
                "q_sensor_segment": list(item.q_sensor_segment),
                "q_optical_world": list(item.q_optical_world),
            }
            for name, item in one.sensor.items()
        }
    rotations = [one.quality["sensors"]["S4"]["q_sensor_segment"] for one in (previous, found)]
    assert rotation.angle_between(*rotations) == pytest.approx(0.2, abs=1e-6)


def test_models_of_unaligned_worlds_are_not_moved_to_aligned_ones() -> None:
    before, worn = worlds(dict.fromkeys(SENSORS, 0.0)), mounts()
    pose = fit_static(standing(before, worn), SETTINGS, CHAIN)
    previous = fit_static_only(pose, None, CHAIN)
    assert "headings_from_static" in previous.flags
    found = static_job(standing(before, worn), previous, worlds(dict.fromkeys(SENSORS, 1.0)))
    assert found.sensor["S1"].q_optical_world == previous.sensor["S1"].q_optical_world


def test_a_sensor_that_is_silent_on_the_plate_is_named_at_once() -> None:
    trial = standing(worlds(dict.fromkeys(SENSORS, 0.0)), mounts())
    heard = {name: track for name, track in trial.sensors.items() if name != "S3"}
    result = run_job(AlignJob(CHAIN, SETTINGS, CalibrationTrial(heard, None)))
    assert "S3" in str(result.refused)


def test_single_moved_sensor_is_reported_at_a_new_static_pose() -> None:
    room, worn = worlds(dict.fromkeys(SENSORS, 0.0)), mounts()
    before = fit_static_only(fit_static(standing(room, worn), SETTINGS, CHAIN), room, CHAIN)
    moved = {**worn, "S4": rotation.multiply(worn["S4"], rotation.exp(np.array([0.2, 0.0, 0.0])))}
    notes: tuple[str, ...] = ()
    for trial, expected in ((standing(room, worn), []), (standing(room, moved), ["shank"])):
        result = run_job(StaticJob(CHAIN, SETTINGS, trial, None, before))
        assert result.notes is not None
        notes = result.notes
        assert [note.partition(":")[0] for note in notes] == expected
    assert "S3 and S4 differ by 11.5 deg" in notes[0]


def test_the_functional_fit_uses_the_lags_of_the_previous_calibration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    room, worn = worlds(dict.fromkeys(SENSORS, 0.0)), mounts()
    before = fit_static_only(fit_static(standing(room, worn), SETTINGS, CHAIN), None, CHAIN)
    given: dict[str, Any] = {}

    def fit(*_: object, **options: object) -> Calibration:
        given.update(options)
        return before

    monkeypatch.setattr("jointfit_daemon.calibration.phases._job_runner.fit_calibration", fit)
    trial = standing(room, worn)
    run_job(FunctionalJob(CHAIN, SETTINGS, trial, trial, None, before))
    assert given["previous"] == before
