"""The calibrated limb: models that are evaluated in every frame, and the record that holds them."""

from jointfit_daemon.limb_model._aligned_model import AlignedModel
from jointfit_daemon.limb_model._calibration import (
    Calibration,
    JointCalibration,
    Method,
    SegmentCalibration,
    SensorCalibration,
    UnknownSchema,
    alive_key,
)
from jointfit_daemon.limb_model._chain_conventions import body_parts, flexion_sign, neighbor
from jointfit_daemon.limb_model._kernel_expert import Expert, as_rows
from jointfit_daemon.limb_model._kernel_features import TILTS, bumps, smooth_terms, widths_of
from jointfit_daemon.limb_model._kernel_model import KernelModel, mix_corrections, model_inputs
from jointfit_daemon.limb_model._kernel_trend import LEVEL_AXES, trend
from jointfit_daemon.limb_model._leverage_variance import FARTHEST, WITHIN, Spread
from jointfit_daemon.limb_model._marker_cluster import (
    Cluster,
    StoredCluster,
    live_cluster,
    stored_cluster,
    vector,
)
from jointfit_daemon.limb_model._mean_model import MeanModel
from jointfit_daemon.limb_model._patent_model import PatentModel, Reading
from jointfit_daemon.limb_model._rigid_fit import (
    MAX_FIT_RMS_M,
    MIN_MARKERS,
    is_line,
    rigid_fit,
    steady_fit,
    visible,
)
from jointfit_daemon.limb_model._segment_model import (
    UNREFERENCED_SD,
    Prediction,
    SegmentModel,
    widened,
)
from jointfit_daemon.limb_model._sensor_link import (
    LEAST_LEVEL,
    Kind,
    SensorLink,
    axis_heading_one,
    level_axis,
    posture_one,
    up_one,
)
from jointfit_daemon.limb_model._weighted_mean import equal_weights, fuse, fuse_one

__all__ = [
    "FARTHEST",
    "LEAST_LEVEL",
    "LEVEL_AXES",
    "MAX_FIT_RMS_M",
    "MIN_MARKERS",
    "TILTS",
    "UNREFERENCED_SD",
    "WITHIN",
    "AlignedModel",
    "Calibration",
    "Cluster",
    "Expert",
    "JointCalibration",
    "KernelModel",
    "Kind",
    "MeanModel",
    "Method",
    "PatentModel",
    "Prediction",
    "Reading",
    "SegmentCalibration",
    "SegmentModel",
    "SensorCalibration",
    "SensorLink",
    "Spread",
    "StoredCluster",
    "UnknownSchema",
    "alive_key",
    "as_rows",
    "axis_heading_one",
    "body_parts",
    "bumps",
    "equal_weights",
    "flexion_sign",
    "fuse",
    "fuse_one",
    "is_line",
    "level_axis",
    "live_cluster",
    "mix_corrections",
    "model_inputs",
    "neighbor",
    "posture_one",
    "rigid_fit",
    "smooth_terms",
    "steady_fit",
    "stored_cluster",
    "trend",
    "up_one",
    "vector",
    "visible",
    "widened",
    "widths_of",
]
