"""Joint centers of both legs, and the axes of the shared pelvis, from markers."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration import CalibrationSettings, OpticalTrack
from jointfit_daemon.calibration.anatomy import find_anatomy, static_cluster, track_clusters
from jointfit_daemon.calibration.guidance import MovementGuide
from jointfit_daemon.model import Chain
from jointfit_simulators.body import LIMBS, SimulatedSubject, Step
from jointfit_simulators.settings import Knobs, perfect

if TYPE_CHECKING:
    from jointfit_daemon.calibration.anatomy import Anatomy

KIND = LIMBS["legs"]
LEGS = Chain(
    ("pelvis_origin", "right_hip", "right_knee", "left_hip", "left_knee", "right_ankle",
     "left_ankle"),
    KIND.chain.segments,
    tuple(
        tuple(name for name, part in KIND.sensors.items() if part == segment)
        for segment in KIND.chain.segments
    ),
    parents=(None, 0, 1, 0, 3, 2, 4),
    left_joints=(False, False, False, True, True, False, True),
    distals=("right_foot", "left_foot"),
)  # fmt: skip
PARTS = tuple(part for part in KIND.clusters if part != "plate")
STAND_S, HZ = 3.0, 20.0


@cache
def found() -> tuple[Anatomy, dict[str, np.ndarray]]:
    """Return the anatomy of a subject without soft-tissue artefact, and its true centers."""
    steps = [Step("stand", STAND_S + 2.0), Step("functional", 40.0)]
    subject = SimulatedSubject(perfect(Knobs()), steps, limb="legs")
    names = tuple(name for cluster in KIND.clusters.values() for name in cluster)
    settings = CalibrationSettings(markers={part: KIND.clusters[part] for part in PARTS})

    def track(t_s: np.ndarray) -> OpticalTrack:
        markers = subject.observe([np.empty(0)] * 10, t_s, np.empty(0)).markers
        nothing = np.empty((len(t_s), 0, 3))
        t_ns = np.round(t_s * 1e9).astype(np.int64)
        return OpticalTrack(t_ns, names, markers, (), nothing, np.empty((len(t_s), 0, 4)))

    still_s = np.arange(0.0, STAND_S, 1 / HZ)
    clusters = {part: static_cluster(track(still_s), part, settings) for part in PARTS}
    tracks = track_clusters(track(np.arange(STAND_S + 3.0, 42.0, 1 / HZ)), clusters)
    truth = subject.observe([np.empty(0)] * 10, np.empty(0), still_s).truth
    return find_anatomy(LEGS, tracks), {n: p.mean(axis=0) for n, p in truth.joints.items()}


def test_both_hips_and_the_joints_below_are_found_on_their_side() -> None:
    anatomy, truth = found()
    for name, center in truth.items():
        joint = anatomy.joints[name]
        assert joint is not None
        assert joint.source == "fit"
        assert 1e3 * np.linalg.norm(joint.center - center) < 3.0, name
    facts = KIND.facts["lengths_m"]
    assert isinstance(facts, dict)
    for segment, length in facts.items():
        assert anatomy.lengths[segment][0] == pytest.approx(length, abs=4e-3), segment


def test_the_pelvis_begins_between_the_hips_and_points_from_left_to_right() -> None:
    anatomy, truth = found()
    origin = anatomy.joints["pelvis_origin"]
    assert origin is not None
    assert origin.source_text == "midpoint"
    middle = (truth["right_hip"] + truth["left_hip"]) / 2
    assert np.linalg.norm(origin.center - middle) < 3e-3
    for segment in LEGS.segments:  # all segment axes of an upright subject equal the world axes
        turn = Rotation.from_quat(anatomy.q_static[segment], scalar_first=True)
        assert np.degrees(turn.magnitude()) < 3.0, segment


def test_the_guide_asks_for_the_movements_of_both_legs() -> None:
    status = MovementGuide(LEGS, CalibrationSettings(), None).update({}, 1.0)
    lacking = [text.partition(":")[0] for text in status.missing]
    assert lacking == ["right_hip", "right_knee", "left_hip", "left_knee"]
    assert status.joints["pelvis_origin"]["source"] == "midpoint"
