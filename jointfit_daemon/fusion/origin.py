"""Where O1 is right now, by the markers beside it.

Law: one camera frame in, one place or None out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from jointfit_daemon.calibration.markers import MAX_FIT_RMS_M, Cluster, rigid_fit
from jointfit_daemon.calibration.result import vector
from jointfit_daemon.calibration.static_pose import live_cluster
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from jointfit_daemon.calibration.result import Calibration
    from jointfit_daemon.model import Chain, MocapFrame, MocapLayout, Vector

Array = NDArray[np.float64]


class OpticalOrigin:
    """Locates the first joint from the body part before it, else from the first segment.

    Parameters
    ----------
    chain : Chain
        Names O1 and its neighbours.
    calibration : Calibration or None
        Holds the clusters and the joint center; without either nothing is ever located.
    """

    def __init__(self, chain: Chain, calibration: Calibration | None) -> None:
        self._center: Array | None = None
        self._clusters: list[Cluster] = []
        self._layout: MocapLayout | None = None
        self._columns: list[list[int] | None] = []
        if calibration is None:
            return
        found = calibration.joint.get(chain.joints[0])
        if found is not None and found.center is not None:
            self._center = np.array(found.center)
        self._clusters = [
            live_cluster(part, calibration.clusters[part])
            for part in (chain.proximal, chain.segments[0])
            if part is not None and part in calibration.clusters
        ]

    def locate(self, frame: MocapFrame) -> Vector | None:
        """Return O1 in the optical world, m; None where too few markers are seen."""
        if self._center is None:
            return None
        if frame.layout is not self._layout:
            self._layout = frame.layout
            self._columns = [_columns(cluster, frame.layout) for cluster in self._clusters]
        for cluster, columns in zip(self._clusters, self._columns, strict=True):
            if columns is None:
                continue
            place = _carry(cluster, columns, frame, self._center)
            if np.isfinite(place).all():
                return vector(place)
        return None


def _columns(cluster: Cluster, layout: MocapLayout) -> list[int] | None:
    """Return the columns of a cluster, None if the stream has too few of its names."""
    if cluster.body is not None:
        return [layout.bodies.index(cluster.body)] if cluster.body in layout.bodies else None
    if any(marker not in layout.markers for marker in cluster.markers):
        return None
    return [layout.markers.index(marker) for marker in cluster.markers]


def _carry(cluster: Cluster, columns: list[int], frame: MocapFrame, center: Array) -> Array:
    if cluster.body is not None:
        q_now = frame.body_orientations[columns[0]]
        q = rotation.multiply(q_now, rotation.conjugate(cluster.q_body))
        p = frame.body_positions[columns[0]]
    else:
        fits = rigid_fit(cluster.template, frame.markers[columns][None])
        q, p = fits[0][0], fits[1][0]
        if not fits[2][0] <= MAX_FIT_RMS_M:
            return np.full(3, np.nan)
    return np.asarray(rotation.rotate(q, center - cluster.origin) + p)
