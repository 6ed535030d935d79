"""Phases of a calibration: plate alignment, static pose, functional, online, offline."""

from jointfit_daemon.calibration.phases._functional import fit_calibration
from jointfit_daemon.calibration.phases._job_runner import run_job
from jointfit_daemon.calibration.phases._offline import (
    Judged,
    Judgement,
    OfflineTrial,
    evaluate,
    fit_offline,
    mounts_of,
)
from jointfit_daemon.calibration.phases._offline_checks import doubts, unmoved
from jointfit_daemon.calibration.phases._online import learn
from jointfit_daemon.calibration.phases._plate_alignment import PlateAlignment, fit_plate_alignment
from jointfit_daemon.calibration.phases._static_pose import StaticPose, fit_static, with_new_static

__all__ = [
    "Judged",
    "Judgement",
    "OfflineTrial",
    "PlateAlignment",
    "StaticPose",
    "doubts",
    "evaluate",
    "fit_calibration",
    "fit_offline",
    "fit_plate_alignment",
    "fit_static",
    "learn",
    "mounts_of",
    "run_job",
    "unmoved",
    "with_new_static",
]
