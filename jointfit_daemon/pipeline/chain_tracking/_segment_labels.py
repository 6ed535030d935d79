"""Search for exchanged labels by the shapes of the segments of a chain model.

If markers on the last segment of a chain are exchanged, inverse kinematics rotates this segment
until its markers fit best. In this wrong pose, other markers seem to be exchanged, or only some
markers have large errors. The shape of the segment's marker cluster does not depend on the pose, so
the search compares shapes.

Invariant: the computation per frame is limited, so a search takes several frames. The last result
is valid until the next result.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.kinematics.chains import rest_state, segment_poses
from jointfit_daemon.limb_model import (
    MIN_MARKERS,
    LabelExamination,
    LabelSearch,
    MarkerCluster,
)
from jointfit_daemon.timing.alignment import RateDivider

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel

_FITS_M = 0.02
"""Largest RMS residual of a segment with correct labels, m."""
SEARCH_HZ = 5.0
"""Largest number of searches per second."""


class SegmentLabels:
    """Searches for exchanged labels among the markers of a chain model.

    Parameters
    ----------
    model : ChainModel
        The chain model.
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

        # The center of a joint without translation is fixed in both adjacent segments.
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
        self._rate = RateDivider(SEARCH_HZ)
        self._examination: LabelExamination | None = None
        self.forget()

    def forget(self) -> None:
        """Discard the last result and end the search, because no marker is suspected."""
        self._examination = None
        self.faults: tuple[tuple[int, ...], ...] = ()
        """Exchanged markers in the last examined frame, as `find_exchanged_labels` returns them."""
        self._rms: Array = np.full(len(self._names), np.nan)

    def begin(self, t_ns: int, measured: Array) -> None:
        """Start a search in the labels of a frame if a search is due and none is running.

        Parameters
        ----------
        t_ns : int
            Instant of the frame.
        measured : ndarray, shape (M, 3)
            Markers of the model, m; NaN where hidden.
        """
        if self._examination is None and self._rate.is_due(t_ns):
            self._examination = LabelExamination(self._search, t_ns, measured[self._rows])

    def advance(self, t_ns: int) -> None:
        """Continue the search during a camera frame."""
        finding = None if self._examination is None else self._examination.advance(t_ns)
        if finding is None:
            return
        self._examination = None
        self._rms = finding.rms
        self.faults = tuple(
            tuple(self._number[name] for name in fault.markers)
            for fault in finding.faults
            if fault.cycle
        )

    def fit(self, markers: Iterable[int]) -> bool:
        """Return whether, in the last result, the segments of these markers fit.

        A marker that was found exchanged does not fit.
        """
        parts = {self._segments[m] for m in markers}
        rms = [self._rms[self._names.index(part)] for part in parts if part in self._names]
        exchanged = {m for fault in self.faults for m in fault}
        return bool(rms) and bool(np.max(rms) < _FITS_M) and exchanged.isdisjoint(markers)
