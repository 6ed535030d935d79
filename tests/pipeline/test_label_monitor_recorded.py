"""Marker labels of a recorded person: exchanges are named, and correct labels give no notice."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.files.mocap import read_marker_trial
from jointfit_daemon.limb_model import (
    Calibration,
    JointCalibration,
    MarkerCluster,
    cluster_record,
    vector,
)
from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline._label_monitor import LabelMonitor
from jointfit_daemon.pipeline.events import Notice
from tests.calibration.synthetic_limb import CHAIN

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.arrays import Array

PARTS = {
    "pelvis": ("L.ASIS", "L.PSIS", "r.ASIS", "r.PSIS"),
    "thigh": ("r_thigh1", "r_thigh2", "r_thigh3", "r_thigh4", "r_thigh5"),
    "shank": ("r_sh2", "r_sh3", "r_sh4", "r_shank_antsup"),
    "foot": ("r_ankle", "r_calc", "r_5meta", "r_toe"),
}
CENTERS = {"hip": "R_HJC", "knee": "r_knee", "ankle": "r_ankle"}
"""Markers near the joint centers."""
LABELS = tuple(name for names in PARTS.values() for name in names)
RATE_HZ = 10
SECONDS = 5.0


def calibration(folder: Path) -> Calibration:
    standing = read_marker_trial(folder / "static1.trc")
    clusters = {}
    for part, names in PARTS.items():
        points = np.nanmedian(standing.points(names), axis=0)
        origin = points.mean(axis=0)
        one = MarkerCluster(part, names, None, points - origin, origin, np.eye(4)[0])
        clusters[part] = cluster_record(one)
    joints = {
        name: JointCalibration(
            vector(np.nanmedian(standing.points([marker])[:, 0], axis=0)), 0.02, "fit"
        )
        for name, marker in CENTERS.items()
    }
    return Calibration(
        "mean", CHAIN.joints, CHAIN.segments, CHAIN.sensors, {}, {}, joints, clusters
    )


def trial(folder: Path, name: str) -> Array:
    """Return markers at 10 Hz, m, shape (50, M, 3); a short trial is repeated."""
    found = read_marker_trial(folder / f"{name}.trc")
    points = found.points(LABELS)[:: round(found.trajectories.rate_hz / RATE_HZ)]
    return np.asarray(np.resize(points, (round(RATE_HZ * SECONDS), *points.shape[1:])))


def notices(monitor: LabelMonitor, positions: Array) -> list[Notice]:
    layout, none = MocapLayout(LABELS, ()), np.zeros((0, 3))
    found: list[Notice] = []
    for k, points in enumerate(positions):
        frame = MocapFrame(0, k, None, layout, points, none, np.zeros((0, 4)))
        outputs = monitor.add_frame(k * 1_000_000_000 // RATE_HZ, frame)
        found += [one for one in outputs if isinstance(one, Notice)]
    return found


@pytest.fixture
def folder(shared_data: Path) -> Path:
    found = shared_data / "opencap_subject4" / "trc"
    if not found.is_dir():
        pytest.skip(f"real recordings are not here: {found}")
    return found


@pytest.mark.parametrize("name", ["DJ1", "STS1", "squats1", "walking1"])
def test_correct_labels_of_a_recorded_person_have_no_notice(folder: Path, name: str) -> None:
    assert notices(LabelMonitor(CHAIN, calibration(folder)), trial(folder, name)) == []


@pytest.mark.parametrize("name", ["squats1", "walking1"])
def test_exchanges_within_a_segment_of_a_recorded_person_are_named(folder: Path, name: str) -> None:
    stored, positions = calibration(folder), trial(folder, name)
    missed = []
    for pair in (pair for names in PARTS.values() for pair in pairwise(names)):
        rows = [LABELS.index(label) for label in pair]
        exchanged = positions.copy()
        exchanged[:, rows] = positions[:, rows[::-1]]
        found = notices(LabelMonitor(CHAIN, stored), exchanged)
        # While one marker of a pair is hidden, the other marker of the pair is named first.
        named = [one.data.get("markers") for one in found]
        if named not in ([list(pair)], [list(pair[::-1])]):
            missed.append((pair, [one.text for one in found]))
    assert missed == []
