"""Position of the first joint (O1) in single mocap frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from jointfit_daemon.calibration.phases import fit_calibration
from jointfit_daemon.fusion import OpticalOrigin
from jointfit_daemon.limb_model import Calibration, JointCalibration
from jointfit_daemon.model import MocapFrame, MocapLayout
from tests.calibration.synthetic_limb import (
    CHAIN,
    SETTINGS,
    Subject,
    motion,
    record,
    static_and_functional,
)

SUBJECT = Subject(5)


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    static, functional, _ = static_and_functional(SUBJECT, 15.0)
    return fit_calibration(static, functional, None, SETTINGS, CHAIN)


def frames() -> tuple[list[MocapFrame], np.ndarray]:
    moving = motion(SUBJECT, 12.0, 400.0)
    optical = record(SUBJECT, moving, 3, sensors=False).optical
    assert optical is not None
    layout = MocapLayout(optical.markers, ())
    none = np.zeros((0, 3))
    t = optical.t_ns.astype(np.float64) / 1e9
    hips = np.stack([np.interp(t, moving.t_s, moving.p["thigh"][:, k]) for k in range(3)], axis=1)
    rows = [
        MocapFrame(int(stamp), k, None, layout, row, none, np.zeros((0, 4)))
        for k, (stamp, row) in enumerate(zip(optical.t_ns, optical.positions, strict=True))
    ]
    return rows, hips


def test_hip_is_located(calibration: Calibration) -> None:
    finder, (rows, hips) = OpticalOrigin(CHAIN, calibration), frames()
    found = np.array([finder.locate(frame) for frame in rows[::20]], dtype=float)
    assert np.sqrt(((found - hips[::20]) ** 2).sum(axis=1).mean()) < 0.006


def test_thigh_replaces_the_pelvis_and_without_both_the_origin_is_unknown(
    calibration: Calibration,
) -> None:
    finder, (rows, hips) = OpticalOrigin(CHAIN, calibration), frames()
    frame = rows[600]
    markers = frame.markers.copy()
    markers[:4] = np.nan
    assert frame.layout.markers[3].startswith("pelvis")
    place = finder.locate(replace(frame, markers=markers))
    assert place is not None
    assert np.linalg.norm(np.array(place) - hips[600]) < 0.01
    markers[4:6] = np.nan
    assert finder.locate(replace(frame, markers=markers)) is None


def test_unknown_joint_or_stream_gives_none(calibration: Calibration) -> None:
    frame = frames()[0][0]
    assert OpticalOrigin(CHAIN, None).locate(frame) is None
    unknown = {**calibration.joint, "hip": JointCalibration(None, None, "unknown")}
    assert OpticalOrigin(CHAIN, replace(calibration, joint=unknown)).locate(frame) is None
    other = replace(frame, layout=MocapLayout(("x",) * len(frame.layout.markers), ()))
    assert OpticalOrigin(CHAIN, calibration).locate(other) is None
