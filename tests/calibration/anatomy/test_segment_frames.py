"""Joint centers, lengths and axes from markers, compared with the simulated geometry."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration import CalibrationError, CalibrationSettings
from jointfit_daemon.calibration.anatomy import (
    Anatomy,
    find_anatomy,
    static_cluster,
    track_clusters,
)
from jointfit_daemon.calibration.anatomy._segment_frames import flexion_axis
from tests.calibration.synthetic_limb import (
    CHAIN,
    LENGTH,
    MARKERS,
    Imperfections,
    Subject,
    static_and_functional,
)

if TYPE_CHECKING:
    from jointfit_daemon.model import Chain


def anatomy(
    subject: Subject, chain: Chain = CHAIN, parts: tuple[str, ...] = tuple(MARKERS)
) -> Anatomy:
    static, functional, _ = static_and_functional(subject)
    settings = CalibrationSettings(markers={part: MARKERS[part] for part in parts})
    assert static.optical is not None
    assert functional.optical is not None
    clusters = {part: static_cluster(static.optical, part, settings) for part in parts}
    return find_anatomy(chain, track_clusters(functional.optical, clusters))


def truth(subject: Subject) -> dict[str, np.ndarray]:
    return {
        "hip": np.array([0, 0, 0.9]),
        "knee": np.array([0, 0, 0.9 - LENGTH["thigh"]]),
        "ankle": np.array([0, 0, 0.9 - LENGTH["thigh"] - LENGTH["shank"]]),
    }


def tilt_deg(q: np.ndarray, subject: Subject) -> float:
    facing = Rotation.from_rotvec([0, 0, subject.facing])
    found = Rotation.from_quat(q, scalar_first=True)
    return float(np.degrees((facing.inv() * found).magnitude()))


@pytest.mark.parametrize(
    ("flaws", "center_mm", "tilt"),
    [(Imperfections(), 3.0, 2.5), (Imperfections(skin_m=0.005, occluded=0.05), 15.0, 4.0)],
)
def test_centers_lengths_and_axes_are_recovered(
    flaws: Imperfections, center_mm: float, tilt: float
) -> None:
    subject = Subject(3, flaws=flaws)
    found = anatomy(subject)
    for joint, where in truth(subject).items():
        joint_found = found.joints[joint]
        assert joint_found is not None
        assert joint_found.source == "fit"
        assert 1000 * np.linalg.norm(joint_found.center - where) < center_mm, joint
    for segment, length in LENGTH.items():
        found_length, sd = found.lengths[segment]
        assert found_length == pytest.approx(length, abs=center_mm / 1000)
        assert sd is not None
        assert tilt_deg(found.q_static[segment], subject) < tilt, segment
    assert found.flags == ()


def test_without_foot_markers_the_ankle_is_a_configured_length_below_the_knee() -> None:
    subject, chain = Subject(1), replace(CHAIN, lengths=(None, 0.4), distal=None)
    found = anatomy(subject, chain, ("pelvis", "thigh", "shank"))
    ankle = found.joints["ankle"]
    assert ankle is not None
    assert ankle.source == "length"
    assert np.linalg.norm(ankle.center - truth(subject)["ankle"]) < 5e-3


def test_unobserved_segment_frames_are_unknown_and_reported() -> None:
    found = anatomy(Subject(1), CHAIN, ("thigh", "shank"))
    assert found.joints["hip"] is None
    assert found.joints["ankle"] is None
    assert found.lengths["thigh"] == (None, None)
    assert "axis_vertical:thigh" in found.flags
    assert any("hip" in note for note in found.notes)
    assert tilt_deg(found.q_static["thigh"], Subject(1)) < 5.0


def test_with_static_axes_every_segment_stands_unrotated() -> None:
    subject = Subject(1)
    found = anatomy(subject, replace(CHAIN, static_axes=True))
    for segment in CHAIN.segments:
        assert found.q_static[segment].tolist() == [1.0, 0.0, 0.0, 0.0]
    assert found.lengths == anatomy(subject).lengths


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_axis_sign_follows_the_joint(sign: float) -> None:
    subject = Subject(2)
    static, functional, _ = static_and_functional(subject, 15.0)
    assert static.optical is not None
    assert functional.optical is not None
    settings = CalibrationSettings(markers=MARKERS)
    clusters = {p: static_cluster(static.optical, p, settings) for p in ("thigh", "shank")}
    tracks = track_clusters(functional.optical, clusters)
    found = flexion_axis(tracks["thigh"], tracks["shank"], np.array([0.0, 0.0, 1.0]), sign)
    assert found is not None
    right = Rotation.from_rotvec([0, 0, subject.facing]).apply([1, 0, 0])
    assert found.axis @ right == pytest.approx(-sign, abs=0.01)


def test_a_movement_about_the_long_axis_only_is_refused() -> None:
    subject = Subject(4)
    static, _, _ = static_and_functional(subject, 10.0)
    assert static.optical is not None
    settings = CalibrationSettings(markers=MARKERS)
    clusters = {p: static_cluster(static.optical, p, settings) for p in ("thigh", "shank")}
    still = static.optical
    angle = np.sin(np.linspace(0, 9, len(still.t_ns)))
    turned = Rotation.from_rotvec(np.outer(angle, [0, 0, 1.0]))
    positions = still.positions.copy()
    for i, name in enumerate(still.markers):
        if name in MARKERS["shank"]:
            positions[:, i] = turned.apply(positions[:, i])
    tracks = track_clusters(replace(still, positions=positions), clusters)
    with pytest.raises(CalibrationError, match="squats"):
        find_anatomy(CHAIN, tracks)
