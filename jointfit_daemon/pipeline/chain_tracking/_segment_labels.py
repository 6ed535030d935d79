"""Exchanged labels by the shapes of the segments of a chain model.

A segment at the end of a chain turns to where its exchanged markers fit best, so that they are near
the places of others, or only some are far from theirs. The shape of its markers does not change.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.chains import rest_state, segment_poses
from jointfit_daemon.limb_model import MIN_MARKERS, LabelSearch, MarkerCluster

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel

_FITS_M = 0.02
"""RMS residual of a segment with correct labels, m."""


class SegmentLabels:
    """Searches exchanged labels of the markers of a chain model.

    Parameters
    ----------
    model : ChainModel
        The chain.
    """

    def __init__(self, model: ChainModel) -> None:
        rotations, origins = (x[0] for x in segment_poses(model, rest_state(model)))
        segments = model.marker_segments
        clusters = []
        for s, name in enumerate(model.segment_names):
            (rows,) = np.nonzero(segments == s)
            if len(rows) < MIN_MARKERS:
                continue
            points = model.positions[rows] @ rotations[s].T + origins[s]
            names = tuple(model.marker_names[row] for row in rows)
            origin, q = points.mean(axis=0), rotation.IDENTITY.copy()
            clusters.append(MarkerCluster(name, names, None, points - origin, origin, q))

        # A joint without translation keeps its center in both segments.
        centers = {}
        for segment, parent in zip(model.segments, model.parents.tolist(), strict=True):
            if segment.parent is not None and segment.joint.kind != "free":
                at = np.array(segment.joint.center_in_parent)
                centers[segment.parent, segment.name] = rotations[parent] @ at + origins[parent]
        self._search = LabelSearch(clusters, centers)
        self._names = [cluster.name for cluster in clusters]
        self._rows = [model.marker_names.index(label) for label in self._search.labels]
        self._segments = [model.segment_names[s] for s in segments]
        self._number = {name: m for m, name in enumerate(model.marker_names)}
        self._faults: tuple[tuple[int, ...], ...] = ()
        self._rms: Array = np.full(len(clusters), np.nan)

    def search(self, measured: Array) -> tuple[tuple[int, ...], ...]:
        """Return exchanged markers in one frame, as `find_exchanged_labels` does.

        Parameters
        ----------
        measured : ndarray, shape (M, 3)
            Markers of the model, m; NaN where hidden.
        """
        self._rms, faults = self._search.explain(measured[self._rows])
        self._faults = tuple(
            tuple(self._number[name] for name in fault.markers) for fault in faults if fault.cycle
        )
        return self._faults

    def fit(self, markers: Iterable[int]) -> bool:
        """Return whether the segments of some markers fit in the last frame, without exchange."""
        parts = {self._segments[m] for m in markers}
        rms = [self._rms[self._names.index(part)] for part in parts if part in self._names]
        exchanged = {m for fault in self._faults for m in fault}
        return bool(rms) and bool(np.max(rms) < _FITS_M) and exchanged.isdisjoint(markers)
