"""Phases of a calibration: plate alignment, static pose, functional, online, offline."""

from jointfit_daemon.calibration.phases._functional import fit_calibration
from jointfit_daemon.calibration.phases._job_runner import run_job
from jointfit_daemon.calibration.phases._offline import (
    MethodEvaluation,
    MethodScore,
    OfflineTrial,
    evaluate,
    fit_offline,
    mounts_of,
)
from jointfit_daemon.calibration.phases._offline_checks import trial_warnings, unmoved_joint
from jointfit_daemon.calibration.phases._online import refit_models
from jointfit_daemon.calibration.phases._plate_alignment import PlateAlignment, fit_plate_alignment
from jointfit_daemon.calibration.phases._quality_figures import joint_record
from jointfit_daemon.calibration.phases._static_pose import StaticPose, fit_static, with_new_static

__all__ = [
    "MethodEvaluation",
    "MethodScore",
    "OfflineTrial",
    "PlateAlignment",
    "StaticPose",
    "evaluate",
    "fit_calibration",
    "fit_offline",
    "fit_plate_alignment",
    "fit_static",
    "joint_record",
    "mounts_of",
    "refit_models",
    "run_job",
    "trial_warnings",
    "unmoved_joint",
    "with_new_static",
]
