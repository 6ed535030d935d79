"""Inverse kinematics, which computes the poses of a chain model that best fit measured markers."""

from jointfit_daemon.kinematics.inverse_kinematics._levenberg_marquardt import Band, limits_of
from jointfit_daemon.kinematics.inverse_kinematics._local_minima import restart_local_minima
from jointfit_daemon.kinematics.inverse_kinematics._normal_equations import (
    MarkerFit,
    lower_equations,
    marker_fit,
    marker_slots,
)
from jointfit_daemon.kinematics.inverse_kinematics._pose_covariance import pose_covariance
from jointfit_daemon.kinematics.inverse_kinematics._sequential_solver import (
    MOST_EVALUATIONS,
    LiveInverseKinematics,
    LiveOptions,
    LivePose,
)
from jointfit_daemon.kinematics.inverse_kinematics._solver import (
    OPEN_M2,
    IkOptions,
    IkResult,
    solve_frames,
    tracking_error,
)

__all__ = [
    "MOST_EVALUATIONS",
    "OPEN_M2",
    "Band",
    "IkOptions",
    "IkResult",
    "LiveInverseKinematics",
    "LiveOptions",
    "LivePose",
    "MarkerFit",
    "limits_of",
    "lower_equations",
    "marker_fit",
    "marker_slots",
    "pose_covariance",
    "restart_local_minima",
    "solve_frames",
    "tracking_error",
]
