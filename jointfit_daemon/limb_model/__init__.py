"""Calibrated limb: record of a calibration, and models that are evaluated in every frame.

The models are fitted in `jointfit_daemon.calibration` and evaluated in `jointfit_daemon.fusion`.
"""

from jointfit_daemon.limb_model._aligned_model import AlignedModel
from jointfit_daemon.limb_model._calibration import (
    CalibratedCenter,
    Calibration,
    CalibrationSchemaError,
    JointCalibration,
    Method,
    Procedure,
    SegmentCalibration,
    SensorCalibration,
    chain_fields,
    model_key,
)
from jointfit_daemon.limb_model._chain_conventions import (
    angle_convention,
    configured_length,
    flexion_sign,
)
from jointfit_daemon.limb_model._chain_topology import (
    InnerJoint,
    body_parts,
    branch_runs,
    distal_joints,
    inner_joints,
    is_left,
    joint_parts,
    neighbor,
    proximal_segment,
)
from jointfit_daemon.limb_model._kernel_expert import KernelExpert, as_rows
from jointfit_daemon.limb_model._kernel_features import TILTS, bumps, smooth_terms, widths_of
from jointfit_daemon.limb_model._kernel_model import KernelModel, mix_corrections, model_inputs
from jointfit_daemon.limb_model._kernel_trend import LEVEL_AXES, trend
from jointfit_daemon.limb_model._label_examination import LabelExamination
from jointfit_daemon.limb_model._label_search import (
    LabelFault,
    LabelSearch,
    explain_trial,
)
from jointfit_daemon.limb_model._leverage_variance import FARTHEST, WITHIN, LeverageVariance
from jointfit_daemon.limb_model._marker_cluster import (
    MarkerCluster,
    StoredCluster,
    cluster_record,
    restore_cluster,
    vector,
)
from jointfit_daemon.limb_model._mean_model import MeanModel
from jointfit_daemon.limb_model._patent_model import PatentModel, PatentReading
from jointfit_daemon.limb_model._refined_chain import RefinedChain, chain_fingerprint
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
    widen_sd,
)
from jointfit_daemon.limb_model._sensor_link import (
    LEAST_LEVEL,
    LinkKind,
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
    "CalibratedCenter",
    "Calibration",
    "CalibrationSchemaError",
    "InnerJoint",
    "JointCalibration",
    "KernelExpert",
    "KernelModel",
    "LabelExamination",
    "LabelFault",
    "LabelSearch",
    "LeverageVariance",
    "LinkKind",
    "MarkerCluster",
    "MeanModel",
    "Method",
    "PatentModel",
    "PatentReading",
    "Prediction",
    "Procedure",
    "RefinedChain",
    "SegmentCalibration",
    "SegmentModel",
    "SensorCalibration",
    "SensorLink",
    "StoredCluster",
    "angle_convention",
    "as_rows",
    "axis_heading_one",
    "body_parts",
    "branch_runs",
    "bumps",
    "chain_fields",
    "chain_fingerprint",
    "cluster_record",
    "configured_length",
    "distal_joints",
    "equal_weights",
    "explain_trial",
    "flexion_sign",
    "fuse",
    "fuse_one",
    "inner_joints",
    "is_left",
    "is_line",
    "joint_parts",
    "level_axis",
    "mix_corrections",
    "model_inputs",
    "model_key",
    "neighbor",
    "posture_one",
    "proximal_segment",
    "restore_cluster",
    "rigid_fit",
    "smooth_terms",
    "steady_fit",
    "trend",
    "up_one",
    "vector",
    "visible",
    "widen_sd",
    "widths_of",
]
