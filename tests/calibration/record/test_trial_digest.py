"""The digest depends on every name and value of the trials, and not on the order of sensors."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest

from jointfit_daemon.calibration import CalibrationTrial, OpticalTrack, SensorTrack
from jointfit_daemon.calibration.record import trials_digest

T_NS = np.array([10, 20], dtype=np.int64)
TRACK = SensorTrack(T_NS, np.arange(8.0).reshape(2, 4))
OTHER = SensorTrack(T_NS + 1, np.arange(8.0, 16.0).reshape(2, 4))
CAMERAS = OpticalTrack(
    T_NS,
    ("A", "B"),
    np.arange(12.0).reshape(2, 2, 3),
    ("Thigh",),
    np.arange(6.0).reshape(2, 1, 3),
    np.arange(8.0).reshape(2, 1, 4),
    np.array([[0.1, 0.2], [0.3, np.nan]]),
)
TRIAL = CalibrationTrial({"S1": TRACK, "S2": OTHER}, CAMERAS)


def test_the_digest_is_that_of_the_named_bytes() -> None:
    """Digests are equal on machines of both byte orders, and equal those of earlier versions."""
    track = SensorTrack(T_NS, np.array([[1.0, 0.0, 0.0, 0.0]] * 2))
    big = SensorTrack(T_NS.astype(">i8"), track.q_world_sensor.astype(">f8"))
    one = np.array([1.0, 0.0, 0.0, 0.0], dtype="<f8").tobytes()
    expected = hashlib.sha256(
        b"trial;trial;S1;(2,);" + T_NS.astype("<i8").tobytes() + b"S1;(2, 4);" + 2 * one
    ).hexdigest()
    for same in (track, big):
        assert trials_digest(None, CalibrationTrial({"S1": same}, None)) == expected


def test_the_order_of_sensors_does_not_change_the_digest() -> None:
    turned = CalibrationTrial({"S2": OTHER, "S1": TRACK}, CAMERAS)
    assert trials_digest(turned) == trials_digest(TRIAL)


@pytest.mark.parametrize(
    "change",
    [
        CalibrationTrial({"S1": TRACK}, CAMERAS),
        CalibrationTrial({"S1": OTHER, "S2": TRACK}, CAMERAS),
        CalibrationTrial(TRIAL.sensors, None),
        *(
            CalibrationTrial(TRIAL.sensors, replace(CAMERAS, **{field: value}))  # type: ignore[arg-type]
            for field, value in {
                "t_ns": T_NS + 1,
                "markers": ("A", "C"),
                "positions": CAMERAS.positions + 1.0,
                "bodies": ("Shank",),
                "body_positions": CAMERAS.body_positions + 1.0,
                "body_orientations": CAMERAS.body_orientations + 1.0,
                "residuals": None,
            }.items()
        ),
    ],
)
def test_every_name_and_value_changes_the_digest(change: CalibrationTrial) -> None:
    assert trials_digest(change) != trials_digest(TRIAL)
    assert trials_digest(TRIAL, change) != trials_digest(change, TRIAL)
