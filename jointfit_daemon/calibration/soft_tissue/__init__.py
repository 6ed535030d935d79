"""Fits of the segment models that correct soft-tissue artefacts."""

from jointfit_daemon.calibration.soft_tissue._error_correlation import (
    error_correlation,
    joint_error_correlations,
)
from jointfit_daemon.calibration.soft_tissue._kernel_expert_fit import fit_expert
from jointfit_daemon.calibration.soft_tissue._kernel_fit import BLOCKS
from jointfit_daemon.calibration.soft_tissue._limb_fit import (
    METHODS,
    LimbTraining,
    evaluate_methods,
    fit_all_sensors,
    fit_models,
    fit_verified_models,
    flexion_error,
    predict_all_sensors,
    regression_quality,
)
from jointfit_daemon.calibration.soft_tissue._mean_fit import fusion_weights
from jointfit_daemon.calibration.soft_tissue._robust_ridge import fit_ridge
from jointfit_daemon.calibration.soft_tissue._segment_fit import fit_segment
from jointfit_daemon.calibration.soft_tissue._segment_training import FEWEST_FRAMES, SegmentTraining
from jointfit_daemon.calibration.soft_tissue._sensor_link_fit import fit_links
from jointfit_daemon.calibration.soft_tissue._training_memory import (
    join_training,
    pack,
    thin_evenly,
    unpack,
)

__all__ = [
    "BLOCKS",
    "FEWEST_FRAMES",
    "METHODS",
    "LimbTraining",
    "SegmentTraining",
    "error_correlation",
    "evaluate_methods",
    "fit_all_sensors",
    "fit_expert",
    "fit_links",
    "fit_models",
    "fit_ridge",
    "fit_segment",
    "fit_verified_models",
    "flexion_error",
    "fusion_weights",
    "join_training",
    "joint_error_correlations",
    "pack",
    "predict_all_sensors",
    "regression_quality",
    "thin_evenly",
    "unpack",
]
