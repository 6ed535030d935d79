"""Marker clusters of the synthetic limb, and label mistakes of a camera operator."""

from __future__ import annotations

from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    Calibration,
    JointCalibration,
    MarkerCluster,
    cluster_record,
    rigid_fit,
    vector,
)
from tests.calibration.synthetic_limb import (
    CHAIN,
    LENGTH,
    LOCAL,
    MARKERS,
    Imperfections,
    Subject,
    static_and_functional,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

CENTERS = {
    ("pelvis", "thigh"): (0.0, 0.0, 0.0),
    ("thigh", "shank"): (0.0, 0.0, -LENGTH["thigh"]),
    ("shank", "foot"): (0.0, 0.0, -LENGTH["thigh"] - LENGTH["shank"]),
}
"""Joint centers of the standing limb relative to the hip, in the axes of the segments, m."""
LABELS = tuple(name for part in LOCAL for name in MARKERS[part])


def clusters_of(static: Array) -> list[MarkerCluster]:
    """Return the clusters of static markers, m, shape (M, 3), in the order of LABELS."""
    found = []
    for part, names in MARKERS.items():
        points = static[[LABELS.index(name) for name in names]]
        origin = points.mean(axis=0)
        found.append(
            MarkerCluster(part, names, None, points - origin, origin, np.array([1.0, 0, 0, 0]))
        )
    return found


@cache
def person(
    seed: int, skin_m: float = 0.004, occluded: float = 0.0, seconds: float = 10.0
) -> tuple[list[MarkerCluster], NDArray[np.int64], Array]:
    """Return clusters, stamps in ns and markers, m, shape (n, M, 3), of a moving limb."""
    subject = Subject(seed, flaws=Imperfections(skin_m=skin_m, occluded=occluded))
    standing, moving, _ = static_and_functional(subject, seconds)
    assert standing.optical is not None
    assert moving.optical is not None
    assert moving.optical.markers == LABELS
    clusters = clusters_of(np.nanmedian(standing.optical.positions, axis=0))
    return clusters, moving.optical.t_ns, moving.optical.positions


def cycled(points: Array, *labels: str) -> Array:
    """Return markers, shape (..., M, 3), with each label at the place of the next one."""
    rows = [LABELS.index(name) for name in labels]
    changed = points.copy()
    changed[..., rows, :] = points[..., rows[1:] + rows[:1], :]
    return changed


def centers_of(clusters: list[MarkerCluster]) -> dict[tuple[str, str], Array]:
    """Return the joint centers of standing clusters in the static world, m, shape (3,) each."""
    # All segment frames of the standing limb have the same axes.
    pelvis, local = clusters[0], np.array(LOCAL["pelvis"])
    q, t, _ = rigid_fit(local, (pelvis.template + pelvis.origin)[None])
    return {parts: rotation.rotate(q[0], np.array(at)) + t[0] for parts, at in CENTERS.items()}


def calibration_of(clusters: list[MarkerCluster]) -> Calibration:
    """Return a calibration with these clusters and their joint centers."""
    found = centers_of(clusters)
    joints = {
        name: JointCalibration(vector(center), 0.0, "fit")
        for name, center in zip(CHAIN.joints, found.values(), strict=True)
    }
    stored = {cluster.name: cluster_record(cluster) for cluster in clusters}
    return Calibration("mean", CHAIN.joints, CHAIN.segments, CHAIN.sensors, {}, {}, joints, stored)
