"""Poses of all body parts in one camera frame at a time, from one batched rigid fit.

The cost of every frame is the same. If the markers of a part do not fit the static pose, the part
has no pose in that frame. Such misfits are counted for the part and for the marker that deviates
most.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import MAX_FIT_RMS_M, MIN_MARKERS, is_line

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import MarkerCluster
    from jointfit_daemon.model import MocapFrame, MocapLayout

Mask = NDArray[np.bool_]

_PATTERNS = 4096
"""Largest number of visibility patterns (sets of visible markers) in the cache."""


class ClusterVisibility(NamedTuple):
    """Visibility of one body part."""

    seen: float
    """Fraction of the frames in which the part has a pose."""
    misfits: float
    """Fraction of the frames in which visible markers did not fit the static pose."""
    suspect: str | None
    """Marker that deviated most in the largest number of misfits; None without misfits."""
    absent: tuple[str, ...]
    """Markers (or the rigid body) that the stream has not contained so far."""


class LiveClusters:
    """Poses of body parts relative to the static pose, frame by frame.

    Parameters
    ----------
    clusters : mapping of str to MarkerCluster
        Body parts in the static pose, by name. A rigid body is represented by four fixed points
        instead of markers.
    """

    def __init__(self, clusters: Mapping[str, MarkerCluster]) -> None:
        self.names = tuple(clusters)
        self._clusters = tuple(clusters.values())

        # Templates of all parts in one array; smaller parts have unused rows.
        sizes = [len(cluster.template) for cluster in self._clusters]
        shape = (len(sizes), max(sizes, default=0))
        self.sizes = tuple(sizes)
        self._template = np.zeros((*shape, 3))
        self._wanted = np.zeros(shape, dtype=np.bool_)
        for i, cluster in enumerate(self._clusters):
            self._template[i, : sizes[i]] = cluster.template
            self._wanted[i, : sizes[i]] = True
        self.origins = np.array([c.origin for c in self._clusters]).reshape(-1, 3)
        self._bodies = [i for i, c in enumerate(self._clusters) if c.body is not None]

        # Number of frames with a pose and number of misfits of each part, and number of misfits in
        # which each marker deviated most.
        self._frames = 0
        self._good = np.zeros(shape[0], dtype=np.int64)
        self._bad = np.zeros(shape[0], dtype=np.int64)
        self._blamed = np.zeros(shape, dtype=np.int64)
        self._known = np.zeros(shape, dtype=np.bool_)
        self._usable: dict[bytes, Mask] = {}

        # Columns of the markers and rigid bodies in the current layout.
        self._layout: MocapLayout | None = None
        self._columns = np.zeros(shape, dtype=np.intp)
        self._missing = ~self._wanted
        self._body_columns: dict[int, int] = {}

        # The last frame.
        self.points = np.full((*shape, 3), np.nan)
        """Markers in the last frame, optical world, m, shape (parts, k, 3), where k is the largest
        number of markers of a part; NaN if not visible, or if the markers of the part do not fit
        the static pose."""
        self.R = np.tile(np.eye(3), (shape[0], 1, 1))
        """Rotation of each part since the static pose, R_now_static, in the last frame, shape
        (parts, 3, 3); valid only where `placed`.
        """
        self.p = np.zeros((shape[0], 3))
        """Position of the origin of each part, m, shape (parts, 3)."""
        self.placed = np.zeros(shape[0], dtype=np.bool_)
        """Whether each part has a pose in the last frame, shape (parts,)."""

    def feed(self, frame: MocapFrame) -> None:
        r"""Fit the pose of every body part in one frame.

        .. math:: \min_{R,t} \sum_k |R a_k + t - y_k|^2

        The sum is over the visible markers, with positions a_k in the template and y_k in the frame
        (Kabsch 1976). All parts are fitted in one call.
        """
        if frame.layout is not self._layout and frame.layout != self._layout:
            self._read(frame.layout)
        self._frames += 1

        # Marker positions in the order of the templates.
        y = np.full_like(self.points, np.nan)
        if len(frame.markers):
            y = frame.markers[self._columns]
        y[self._missing] = np.nan
        for i in self._bodies:
            y[i, : self.sizes[i]] = self._virtual(i, frame)

        seen: Mask = np.asarray(np.isfinite(y).all(axis=2))
        ok = self._enough(seen)
        self.points = y
        gap = self._fit(np.where(seen[..., None], y, 0.0), np.asarray(seen, dtype=np.float64))

        # Parts with a large residual have no pose, and the marker that deviates most is counted.
        count = np.maximum(seen.sum(axis=1), 1)
        wrong = ok & (gap.sum(axis=1) / count > MAX_FIT_RMS_M**2)
        self.placed = ok & ~wrong
        self._good += self.placed
        for i in np.flatnonzero(wrong).tolist():
            # Find the marker with the largest change of its distances to other markers.
            known = np.where(seen[i, :, None], y[i], 0.0)
            now, then = (
                np.linalg.norm(x[:, None] - x[None], axis=2) for x in (known, self._template[i])
            )
            change = (np.abs(now - then) * np.outer(seen[i], seen[i])).sum(axis=1)
            self._bad[i] += 1
            self._blamed[i, int(change.argmax())] += 1
            y[i] = np.nan

    def _read(self, layout: MocapLayout) -> None:
        """Find the columns of a new layout; missing names count as not visible."""
        self._layout = layout
        markers = {name: i for i, name in enumerate(layout.markers)}
        bodies = {name: i for i, name in enumerate(layout.bodies)}
        self._columns[:], self._missing[:] = 0, True
        self._body_columns = {}

        for i, cluster in enumerate(self._clusters):
            if cluster.body is not None and cluster.body in bodies:
                self._body_columns[i] = bodies[cluster.body]
                self._known[i] = True
            for k, name in enumerate(cluster.markers):
                if name in markers:
                    self._columns[i, k], self._missing[i, k] = markers[name], False
                    self._known[i, k] = True

    def _virtual(self, i: int, frame: MocapFrame) -> Array:
        """Return the virtual points of a rigid body; NaN while it is not visible."""
        column = self._body_columns.get(i)
        if column is None:
            return np.full((self.sizes[i], 3), np.nan)
        q_body = np.asarray(frame.body_orientations[column], dtype=np.float64)
        q = rotation.multiply(q_body, rotation.conjugate(self._clusters[i].q_body))
        norm = float(np.sqrt(q @ q))
        if not norm > 0.0:  # also True for NaN
            return np.full((self.sizes[i], 3), np.nan)
        R = rotation.to_matrix(q / norm)
        return np.asarray(self._clusters[i].template @ R.T + frame.body_positions[column])

    def _enough(self, seen: Mask) -> Mask:
        """Return the parts with at least three visible markers that are not on a line."""
        key = seen.tobytes()
        known = self._usable.get(key)
        if known is None:
            # A movement has few patterns. The limit applies if markers flicker.
            if len(self._usable) >= _PATTERNS:
                self._usable.clear()
            known = np.array(
                [
                    np.count_nonzero(row) >= MIN_MARKERS and not is_line(self._template[i][row])
                    for i, row in enumerate(seen)
                ],
                dtype=np.bool_,
            )
            self._usable[key] = known
        return known

    def _fit(self, y: Array, w: Array) -> Array:
        """Fit all parts; return the squared residual of every marker, m², shape (parts, k)."""
        total = np.maximum(w.sum(axis=1), 1.0)[:, None, None]
        weight = w[:, None, :]
        a_mean, y_mean = weight @ self._template / total, weight @ y / total
        a = (self._template - a_mean) * w[..., None]

        # The singular vectors of the cross moment determine the rotation without reflection.
        U, _, Vt = np.linalg.svd(np.swapaxes(a, 1, 2) @ y)
        mirrored = np.linalg.det(U @ Vt) < 0.0
        Vt[mirrored, 2] *= -1.0
        R = np.swapaxes(U @ Vt, 1, 2)

        t = y_mean - a_mean @ np.swapaxes(R, 1, 2)
        gap = self._template @ np.swapaxes(R, 1, 2) + t - y
        self.R, self.p = R, t[:, 0]
        return np.asarray((gap * gap).sum(axis=2) * w)

    def visibility(self) -> dict[str, ClusterVisibility]:
        """Return the visibility of each body part since the start."""
        frames = max(self._frames, 1)
        found = {}
        for i, (name, cluster) in enumerate(zip(self.names, self._clusters, strict=True)):
            labels = cluster.markers or (cluster.body or name,) * self.sizes[i]
            worst = labels[int(self._blamed[i, : self.sizes[i]].argmax())]

            unknown = ~self._known[i] & (self._frames > 0)
            absent = tuple(dict.fromkeys(label for k, label in enumerate(labels) if unknown[k]))
            found[name] = ClusterVisibility(
                float(self._good[i]) / frames,
                float(self._bad[i]) / frames,
                worst if self._bad[i] else None,
                absent,
            )
        return found
