"""Pose of a marker cluster, and of points fixed to it, in single mocap frames.

The result equals the result of ``limb_model.rigid_fit``, except for rounding. Quantities that do
not change from frame to frame are computed once for each set of visible markers. The computation of
a frame uses plain floats, because for matrices this small the overhead of a NumPy call exceeds the
time of the arithmetic. The overhead is several times larger if the processor caches no longer
contain the code of NumPy.

The *static world* is the optical world as it was during the static pose.
"""

from __future__ import annotations

from math import isfinite, sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.arrays import Array  # noqa: TC001 - mypyc evaluates the types of fields
from jointfit_daemon.fusion._rotation_fit import fit_rotation
from jointfit_daemon.kinematics.rotation_scalar import (
    as_quaternion,
    conjugate_one,
    multiply_one,
    rotate_one,
)
from jointfit_daemon.limb_model import MAX_FIT_RMS_M, MIN_MARKERS, is_line
from jointfit_daemon.model import Quaternion, Vector  # noqa: TC001 - as above

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import MarkerCluster
    from jointfit_daemon.model import MocapFrame, MocapLayout


class _MarkerSubset(NamedTuple):
    """Precomputed quantities of one set of visible markers."""

    rows: list[int]
    """Rows of the cluster template."""
    centered: list[Vector]
    """Template positions relative to the mean of these markers, m."""
    offsets: list[Vector]
    """Vectors from the mean of these markers to the fixed points of `ClusterPose`, static world, m.
    """
    moment: float
    """Sum of the squares of `centered`, m²."""


class FittedPose(NamedTuple):
    """Rigid motion of a cluster from the static pose to one frame."""

    q: Quaternion
    """Rotation q_optical_static from the static world to the optical world."""
    points: list[Vector]
    """Positions of the fixed points, optical world, m."""


class ClusterPose:
    """Pose of a cluster in frames of one layout.

    Parameters
    ----------
    cluster : MarkerCluster
        Markers of the body part, or its rigid body.
    points : ndarray, shape (n, 3)
        Points fixed to the cluster, such as joint centers, in the static world, m.
    layout : MocapLayout
        Layout of the frames.
    """

    def __init__(self, cluster: MarkerCluster, points: Array, layout: MocapLayout) -> None:
        self._cluster = cluster
        self._offsets: Array = points - cluster.origin
        self._subsets: dict[bytes, _MarkerSubset | None] = {}
        columns = _columns(cluster, layout)
        self._columns = None if columns is None else np.array(columns, dtype=np.intp)
        self._all = None if cluster.body else self._subset(bytes([1]) * len(cluster.markers))
        """Quantities of the set of all markers, which is the usual case."""

    def fit(self, frame: MocapFrame) -> FittedPose | None:
        """Return the pose in `frame`; None if too few markers are visible or they do not fit."""
        columns = self._columns
        if columns is None:
            return None
        if self._cluster.body is None:
            return self._fit_markers(_vectors(frame.markers.take(columns, axis=0)))

        column = columns[0]
        x, y, z = position = frame.body_positions[column].tolist()
        now = as_quaternion(frame.body_orientations[column].tolist())
        if not all(map(isfinite, (*position, *now))):
            return None
        q = multiply_one(now, conjugate_one(as_quaternion(self._cluster.q_body)))
        turned = [rotate_one(q, (x, y, z)) for x, y, z in self._offsets.tolist()]
        return FittedPose(q, [(x + dx, y + dy, z + dz) for dx, dy, dz in turned])

    def _fit_markers(self, seen: list[Vector]) -> FittedPose | None:
        r"""Return the pose from the visible markers, with the rotation of Horn (1987).

        a and y are the positions of a marker in the template and in the frame, relative to their
        means. If :math:`\lambda` is the largest sum of ``y · R a``, the sum of squared residuals
        is :math:`\sum |a|^2 + \sum |y|^2 - 2 \lambda`.
        """
        subset = self._all
        if not all(isfinite(x + y + z) for x, y, z in seen):
            visible = bytes([isfinite(x + y + z) for x, y, z in seen])
            if visible not in self._subsets:
                self._subsets[visible] = self._subset(visible)
            subset = self._subsets[visible]
            seen = [] if subset is None else [seen[row] for row in subset.rows]
        if subset is None:
            return None

        count = len(seen)
        mx = sum([x for x, _, _ in seen]) / count
        my = sum([y for _, y, _ in seen]) / count
        mz = sum([z for _, _, z in seen]) / count

        # Compute the cross moment of template and markers, and the moment of the markers.
        xx = xy = xz = yx = yy = yz = zx = zy = zz = squares = 0.0
        for (ax, ay, az), (x, y, z) in zip(subset.centered, seen, strict=True):
            dx, dy, dz = x - mx, y - my, z - mz
            xx, xy, xz = xx + ax * dx, xy + ax * dy, xz + ax * dz
            yx, yy, yz = yx + ay * dx, yy + ay * dy, yz + ay * dz
            zx, zy, zz = zx + az * dx, zy + az * dy, zz + az * dz
            squares += dx * dx + dy * dy + dz * dz

        moment = ((xx, xy, xz), (yx, yy, yz), (zx, zy, zz))
        try:
            q, largest = fit_rotation(moment, sqrt(subset.moment * squares))
        except ZeroDivisionError:  # the markers coincide or lie on a line
            return None
        if not subset.moment + squares - 2.0 * largest <= MAX_FIT_RMS_M**2 * count:
            return None
        turned = [rotate_one(q, offset) for offset in subset.offsets]
        return FittedPose(q, [(mx + x, my + y, mz + z) for x, y, z in turned])

    def _subset(self, visible: bytes) -> _MarkerSubset | None:
        rows = [row for row, seen in enumerate(visible) if seen]
        template = self._cluster.template[rows]
        if len(rows) < MIN_MARKERS or is_line(template):
            return None
        mean = template.mean(axis=0)
        centered = template - mean
        offsets = _vectors(self._offsets - mean)
        return _MarkerSubset(rows, _vectors(centered), offsets, float((centered**2).sum()))


def _vectors(rows: Array) -> list[Vector]:
    """Return the rows of an array as tuples, which compiled code requires."""
    return [(x, y, z) for x, y, z in rows.tolist()]


def _columns(cluster: MarkerCluster, layout: MocapLayout) -> list[int] | None:
    """Return the columns of a cluster, or None if the stream lacks its body or a marker."""
    if cluster.body is not None:
        return [layout.bodies.index(cluster.body)] if cluster.body in layout.bodies else None
    if any(marker not in layout.markers for marker in cluster.markers):
        return None
    return [layout.markers.index(marker) for marker in cluster.markers]
