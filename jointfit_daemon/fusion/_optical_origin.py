"""Position of the first joint of a limb (O1) in a mocap frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.fusion._cluster_pose import ClusterPose
from jointfit_daemon.limb_model import restore_cluster

if TYPE_CHECKING:
    from jointfit_daemon.limb_model import Calibration, MarkerCluster
    from jointfit_daemon.model import Chain, MocapFrame, MocapLayout, Vector


class OpticalOrigin:
    """Locates O1 from the markers of the proximal body part, or else of the first segment.

    Parameters
    ----------
    chain : Chain
        Chain whose first joint is O1.
    calibration : Calibration or None
        Marker clusters and joint center. Without a calibration O1 is never located.
    """

    def __init__(self, chain: Chain, calibration: Calibration | None) -> None:
        self._center: Vector | None = None
        self._clusters: list[MarkerCluster] = []
        self._layout: MocapLayout | None = None
        self._poses: list[ClusterPose] = []
        if calibration is None:
            return
        found = calibration.joint.get(chain.joints[0])
        self._center = None if found is None else found.center
        self._clusters = [
            restore_cluster(part, calibration.clusters[part])
            for part in (chain.proximal, chain.segments[0])
            if part is not None and part in calibration.clusters
        ]

    def locate(self, frame: MocapFrame) -> Vector | None:
        """Return O1 in the optical world, m, or None if too few markers are visible."""
        if self._center is None:
            return None
        if frame.layout is not self._layout:
            self._layout = frame.layout
            center = np.array([self._center])
            self._poses = [ClusterPose(c, center, frame.layout) for c in self._clusters]

        for pose in self._poses:
            fitted = pose.fit(frame)
            if fitted is not None:
                return fitted.points[0]
        return None
