r"""Where the markers of body parts are while moving: refined clusters from the functional phase.

Law: the static pose shows markers once, on skin that moves; a movement shows them thousands of
times, and shows one that was knocked off since. Each part's markers are refined against the
movement (`marker_refinement`, no joints between the parts: joint centers found through skin are a
centimeter off and would bend the shapes). Tracking cannot see a turn of a whole part, so the
refined shape :math:`p'` is laid back on the pose :math:`p`, robustly,

.. math:: \min_{R,t} \sum_k \rho(|R p'_k + t - p_k|)

with Huber's :math:`\rho`, and a marker that moved alone does not turn its part. Learned from the
first part of the trial, judged on the rest; a part whose error did not fall there stays as it was.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

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
    from jointfit_daemon.calibration.marker_refinement import Refinement
    from jointfit_daemon.limb_model import Cluster

FARTHEST_M = 0.03
"""A marker that would move farther is another one, or is no longer on this part."""
ALONE_M = 0.004
"""A marker farther from the others' place than this is taken to have moved alone."""
_ROBUST = IkOptions(huber_m=ALONE_M, reweightings=12)


@dataclass(frozen=True, slots=True)
class RefinedClusters:
    """Body parts as they are used from here on, and what refining them did."""

    clusters: Mapping[str, Cluster]
    figures: Mapping[str, Any] | None
    """``parts``: per part RMS before and after on the part of the trial that was not learned from,
    and whether the refined one is used; ``moved_m`` per marker. None: nothing was refined."""
    notes: tuple[str, ...] = field(default=())


def refine_clusters(
    clusters: Mapping[str, Cluster], tracks: Mapping[str, ClusterTrack], holdout_share: float
) -> RefinedClusters:
    """Refine the markers of body parts on a movement.

    Parameters
    ----------
    clusters
        Parts as they stood in the static pose; rigid bodies stay as they are.
    tracks
        The same parts moving, markers as seen in ``points``.
    holdout_share
        Last share of the movement, contiguous, that judges.

    Returns
    -------
    RefinedClusters
        The given ones, with a note that says why, where nothing could be refined.
    """
    marked = {name: c for name, c in clusters.items() if c.body is None and name in tracks}
    if not marked:
        text = "markers not refined: the cameras send rigid bodies, not their single markers"
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
    return _judged(clusters, marked, model, found)


def _model(marked: Mapping[str, Cluster]) -> ChainModel:
    """Return the parts, each on its own, in the axes of the static world around its origin."""
    return ChainModel(
        tuple(Segment(name) for name in marked),
        tuple(
            Marker(marker, name, (x, y, z))
            for name, cluster in marked.items()
            for marker, (x, y, z) in zip(cluster.markers, cluster.template.tolist(), strict=True)
        ),
        "body parts",
    )


def _judged(
    clusters: Mapping[str, Cluster],
    marked: Mapping[str, Cluster],
    model: ChainModel,
    found: Refinement,
) -> RefinedClusters:
    """Keep the parts that follow unseen movement better and are still themselves."""
    judge = next(trial for trial in found.trials if not trial.trained)
    used, parts = dict(clusters), {}
    moved: dict[str, float] = {}
    notes: list[str] = []
    for i, (name, cluster) in enumerate(marked.items()):
        mine = model.marker_segments == i
        before, after = _rms(judge.before.by_marker[mine]), _rms(judge.after.by_marker[mine])
        other = laid_back(cluster, found.model.positions[mine])
        shift = other.template + other.origin - cluster.template - cluster.origin
        lengths = np.linalg.norm(shift, axis=1)
        far = int(lengths.argmax())
        better = bool(after < before and lengths[far] < FARTHEST_M)
        parts[name] = {"before_m": before, "after_m": after, "refined": better}
        if better:
            used[name] = other
            moved |= dict(zip(cluster.markers, lengths.tolist(), strict=True))
        elif lengths[far] >= FARTHEST_M:
            notes.append(
                f"{name}: markers not refined: {cluster.markers[far]} would move by "
                f"{1000 * lengths[far]:.0f} mm; check the labels of {', '.join(cluster.markers)}"
            )
    return RefinedClusters(used, {"parts": parts, "moved_m": moved}, tuple(notes))


def _rms(by_marker: Array) -> float:
    seen = by_marker[np.isfinite(by_marker)]
    return float(np.sqrt((seen**2).mean())) if seen.size else 0.0


def laid_back(cluster: Cluster, shape: Array) -> Cluster:
    """Return a part with another shape, m, shape (k, 3), in its place in the static pose."""
    model = _model({cluster.name: cluster}).with_markers(shape)
    placed = solve_frames(model, cluster.template[None], options=_ROBUST)
    points = shape @ placed.rotations[0, 0].T + placed.origins[0, 0] + cluster.origin
    origin = points.mean(axis=0)
    return replace(cluster, template=points - origin, origin=origin)
