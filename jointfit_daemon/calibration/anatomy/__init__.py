"""Marker clusters, joint centers and segment frames."""

from jointfit_daemon.calibration.anatomy._joint_center import (
    MIN_DIRECTION_RAD,
    UNSEEN_SD_M,
    CenterOfRotation,
)
from jointfit_daemon.calibration.anatomy._marker_clusters import (
    ClusterTrack,
    columns,
    marked_parts,
    moving_template,
    static_cluster,
    track_cluster,
    track_clusters,
)
from jointfit_daemon.calibration.anatomy._segment_frames import (
    SKIN_SD_M,
    Anatomy,
    JointFound,
    find_anatomy,
    on_skin,
    settle_unseen,
)
from jointfit_daemon.calibration.anatomy._standing_prior import stand_straight

__all__ = [
    "MIN_DIRECTION_RAD",
    "SKIN_SD_M",
    "UNSEEN_SD_M",
    "Anatomy",
    "CenterOfRotation",
    "ClusterTrack",
    "JointFound",
    "columns",
    "find_anatomy",
    "marked_parts",
    "moving_template",
    "on_skin",
    "settle_unseen",
    "stand_straight",
    "static_cluster",
    "track_cluster",
    "track_clusters",
]
