"""One point of one body part, carried along by the markers of one camera frame.

Law: the fit of ``calibration.markers.rigid_fit`` for a single frame, to rounding; what does not
change from frame to frame is worked out once for every set of visible markers. A general fit of
one frame costs a quarter of a millisecond, this one a tenth of that.
"""

from __future__ import annotations

from math import isfinite
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.kinematics.rotation_scalar import (
    as_quaternion,
    conjugate_one,
    multiply_one,
    rotate_one,
)
from jointfit_daemon.limb_model import MAX_FIT_RMS_M, MIN_MARKERS, is_line

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import Cluster
    from jointfit_daemon.model import MocapFrame, MocapLayout, Vector


class _Pattern(NamedTuple):
    """What is known beforehand of one set of visible markers."""

    rows: list[int]
    """Of the cluster."""
    across: Array
    """Transposed template about the mean of these markers, m, shape (3, k)."""
    arm: Array
    """The carried point seen from that mean, static world, m, shape (3,)."""
    moment: float
    """Sum of the squares of `across`, m²."""


class CarriedPoint:
    """A point fixed to a cluster, found anew in every frame of one layout.

    Parameters
    ----------
    cluster : Cluster
        The body part.
    point : ndarray, shape (3,)
        The point, static world, m.
    layout : MocapLayout
        Columns of the frames to come.
    """

    def __init__(self, cluster: Cluster, point: Array, layout: MocapLayout) -> None:
        self._cluster = cluster
        self._arm: Array = point - cluster.origin
        self._patterns: dict[bytes, _Pattern | None] = {}
        self._columns = _columns(cluster, layout)

    def locate(self, frame: MocapFrame) -> Vector | None:
        """Return where the point is now, optical world, m; None where too little is seen."""
        if self._columns is None:
            return None
        if self._cluster.body is not None:
            return self._by_body(frame, self._columns[0])
        return self._by_markers(frame.markers[self._columns])

    def _by_body(self, frame: MocapFrame, column: int) -> Vector | None:
        x, y, z = frame.body_positions[column].tolist()
        turn = as_quaternion(frame.body_orientations[column].tolist())
        q = multiply_one(turn, conjugate_one(as_quaternion(self._cluster.q_body)))
        ax, ay, az = self._arm.tolist()
        dx, dy, dz = rotate_one(q, (ax, ay, az))
        return _whole(x + dx, y + dy, z + dz)

    def _by_markers(self, seen_at: Array) -> Vector | None:
        r"""Kabsch's rotation over the visible markers.

        With singular values s of the cross moment and the sign d of the third axis, the squared
        distance left is :math:`\sum |a|^2 + \sum |y|^2 - 2 (s_1 + s_2 + d s_3)`.
        """
        visible = np.isfinite(seen_at).all(axis=1).tobytes()  # one byte a marker
        if visible not in self._patterns:
            self._patterns[visible] = self._pattern(visible)
        pattern = self._patterns[visible]
        if pattern is None:
            return None
        count = len(pattern.rows)
        y = seen_at if count == len(seen_at) else seen_at[pattern.rows]
        middle = y.sum(axis=0) / count
        y = y - middle
        u, s, vt = np.linalg.svd(pattern.across @ y)
        sign = 1.0 if _determinant(u.tolist()) * _determinant(vt.tolist()) > 0.0 else -1.0
        vt[2] *= sign
        left = pattern.moment + float((y * y).sum()) - 2.0 * float(s[0] + s[1] + sign * s[2])
        if not left <= MAX_FIT_RMS_M**2 * count:
            return None
        px, py, pz = ((pattern.arm @ u) @ vt + middle).tolist()
        return px, py, pz

    def _pattern(self, visible: bytes) -> _Pattern | None:
        rows = [row for row, seen in enumerate(visible) if seen]
        template = self._cluster.template[rows]
        if len(rows) < MIN_MARKERS or is_line(template):
            return None
        middle = template.mean(axis=0)
        across = (template - middle).T.copy()
        return _Pattern(rows, across, self._arm - middle, float((across**2).sum()))


def _columns(cluster: Cluster, layout: MocapLayout) -> list[int] | None:
    """Return the columns of a cluster, None if the stream has too few of its names."""
    if cluster.body is not None:
        return [layout.bodies.index(cluster.body)] if cluster.body in layout.bodies else None
    if any(marker not in layout.markers for marker in cluster.markers):
        return None
    return [layout.markers.index(marker) for marker in cluster.markers]


def _determinant(m: list[list[float]]) -> float:
    (a, b, c), (d, e, f), (g, h, i) = m
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def _whole(x: float, y: float, z: float) -> Vector | None:
    return (x, y, z) if isfinite(x) and isfinite(y) and isfinite(z) else None
