"""Marker clusters, joint centers and segment frames."""

from jointfit_daemon.calibration.anatomy._chosen_center import CenterChoice
from jointfit_daemon.calibration.anatomy._foreign_markers import ForeignMarker, foreign_markers
from jointfit_daemon.calibration.anatomy._joint_center import (
    MIN_DIRECTION_RAD,
)
from jointfit_daemon.calibration.anatomy._marker_clusters import (
    ClusterTrack,
    body_column,
    columns,
    exchanged_labels,
    marked_parts,
    moving_template,
    static_cluster,
    track_cluster,
    track_clusters,
)
from jointfit_daemon.calibration.anatomy._segment_frames import (
    CONFIGURED_SD_M,
    SKIN_SD_M,
    Anatomy,
    JointCenter,
    artefact_covariance,
    find_anatomy,
    on_skin,
    place_unobserved,
    posture_covariance,
)
from jointfit_daemon.calibration.anatomy._standing_prior import apply_standing_prior

__all__ = [
    "CONFIGURED_SD_M",
    "MIN_DIRECTION_RAD",
    "SKIN_SD_M",
    "Anatomy",
    "CenterChoice",
    "ClusterTrack",
    "ForeignMarker",
    "JointCenter",
    "apply_standing_prior",
    "artefact_covariance",
    "body_column",
    "columns",
    "exchanged_labels",
    "find_anatomy",
    "foreign_markers",
    "marked_parts",
    "moving_template",
    "on_skin",
    "place_unobserved",
    "posture_covariance",
    "static_cluster",
    "track_cluster",
    "track_clusters",
]
