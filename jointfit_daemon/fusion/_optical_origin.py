"""Where O1 is right now, by the markers beside it.

Law: one camera frame in, one place or None out.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.fusion._cluster_point import CarriedPoint
from jointfit_daemon.limb_model import live_cluster

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration, Cluster
    from jointfit_daemon.model import Chain, MocapFrame, MocapLayout, Vector


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
        self._center: Vector | None = None
        self._clusters: list[Cluster] = []
        self._layout: MocapLayout | None = None
        self._carried: list[CarriedPoint] = []
        if calibration is None:
            return
        found = calibration.joint.get(chain.joints[0])
        self._center = None if found is None else found.center
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
            center = np.array(self._center)
            self._carried = [CarriedPoint(c, center, frame.layout) for c in self._clusters]
        for point in self._carried:
            place = point.locate(frame)
            if place is not None:
                return place
        return None
