r"""Refinement of marker positions on body parts from the functional movement.

The static pose shows the markers in one state of the soft tissue. The movement shows thousands of
states, and therefore whether a marker is displaced. The markers of each part are refined by
`marker_refinement`, without joints between the parts, because joint centers from skin markers have
errors of a centimeter and would distort the shapes. A rotation of a whole part is unobservable. The
refined shape :math:`p'` is therefore fitted to the marker positions :math:`p` of the static pose,

.. math:: \min_{R,t} \sum_k \rho(|R p'_k + t - p_k|)

with the Huber loss :math:`\rho`, so that a single displaced marker does not rotate its part. The
refinement uses the first section of the trial and is evaluated on the rest. A body part is
unchanged if the refinement does not reduce its error on the rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._quality import MarkerQuality, PartQuality
from jointfit_daemon.calibration._robust_weights import rms
from jointfit_daemon.calibration.marker_refinement import (
    MotionTrial,
    RefinementError,
    refine_markers,
)
from jointfit_daemon.kinematics.chains import ChainModel, Marker, Segment
from jointfit_daemon.kinematics.inverse_kinematics import IkOptions, solve_frames

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.anatomy import ClusterTrack
    from jointfit_daemon.limb_model import MarkerCluster

FARTHEST_M = 0.03
"""Largest plausible displacement of a marker, m. A larger displacement indicates a wrong label or a
marker that fell off.
"""
ALONE_M = 0.004
"""Residual above which an individual marker counts as displaced, m."""
_ROBUST = IkOptions(huber_m=ALONE_M, reweightings=12)


@dataclass(frozen=True, slots=True)
class RefinedClusters:
    """Body parts after refinement, with quality figures."""

    clusters: Mapping[str, MarkerCluster]
    figures: MarkerQuality | None
    """Figures of the refinement; None if nothing was refined."""
    notes: tuple[str, ...] = ()


def refine_clusters(
    clusters: Mapping[str, MarkerCluster], tracks: Mapping[str, ClusterTrack], holdout_share: float
) -> RefinedClusters:
    """Refine the markers of body parts from a movement.

    Parameters
    ----------
    clusters
        Body parts in the static pose; rigid bodies are unchanged.
    tracks
        The same parts in the movement, with markers in ``points``.
    holdout_share
        Fraction of the movement, at its end, that is used for the evaluation.

    Returns
    -------
    RefinedClusters
        Refined clusters. If no part could be refined, the clusters are unchanged, and a note
        contains the reason.
    """
    marked = {name: c for name, c in clusters.items() if c.body is None and name in tracks}
    if not marked:
        text = "markers not refined: the cameras send rigid bodies without single markers"
        return RefinedClusters(clusters, None, (text,))

    model = _model(marked)
    points = np.concatenate([tracks[name].points for name in marked], axis=1)
    t_ns = tracks[next(iter(marked))].t_ns
    moving = MotionTrial("functional", points, 1e9 / float(np.median(np.diff(t_ns))))
    learned, unseen = moving.split(holdout_share)

    try:
        found = refine_markers(model, [learned], validation=[unseen])
    except RefinementError as refusal:
        return RefinedClusters(clusters, None, (f"markers not refined: {refusal}",))

    # Only parts with a smaller held-out error and plausible marker displacements are used.
    holdout = next(trial for trial in found.trials if not trial.trained)
    used, parts = dict(clusters), {}
    moved: dict[str, float] = {}
    notes: list[str] = []
    for i, (name, cluster) in enumerate(marked.items()):
        mine = model.marker_segments == i
        before, after = (rms(one.by_marker[mine], 0.0) for one in (holdout.before, holdout.after))
        other = fit_shape_to_pose(cluster, found.model.positions[mine])
        shift = other.template + other.origin - cluster.template - cluster.origin
        lengths = np.linalg.norm(shift, axis=1)
        far = int(lengths.argmax())
        better = bool(after < before and lengths[far] < FARTHEST_M)
        parts[name] = PartQuality(before, after, better)

        if better:
            used[name] = other
            moved |= dict(zip(cluster.markers, lengths.tolist(), strict=True))
        elif lengths[far] >= FARTHEST_M:
            notes.append(
                f"{name}: markers not refined: {cluster.markers[far]} would move by "
                f"{1000 * lengths[far]:.0f} mm; check the labels of {', '.join(cluster.markers)}"
            )
    return RefinedClusters(used, MarkerQuality(parts, moved), tuple(notes))


def _model(marked: Mapping[str, MarkerCluster]) -> ChainModel:
    """Return a model of the unconnected parts with the axes of the optical world."""
    return ChainModel(
        tuple(Segment(name) for name in marked),
        tuple(
            Marker(marker, name, (x, y, z))
            for name, cluster in marked.items()
            for marker, (x, y, z) in zip(cluster.markers, cluster.template.tolist(), strict=True)
        ),
        "body parts",
    )


def fit_shape_to_pose(cluster: MarkerCluster, shape: Array) -> MarkerCluster:
    """Return a part with its k markers at `shape`, m, shape (k, 3), fitted to the static pose."""
    model = _model({cluster.name: cluster}).with_markers(shape)
    placed = solve_frames(model, cluster.template[None], options=_ROBUST)
    points = shape @ placed.rotations[0, 0].T + placed.origins[0, 0] + cluster.origin
    origin = points.mean(axis=0)
    return replace(cluster, template=points - origin, origin=origin)
