"""Inverse kinematics: the poses of a chain model that best fit measured markers."""

from jointfit_daemon.kinematics.inverse_kinematics._levenberg_marquardt import Band, limits_of
from jointfit_daemon.kinematics.inverse_kinematics._normal_equations import (
    Fit,
    fit,
    lower_equations,
    slots_of,
)
from jointfit_daemon.kinematics.inverse_kinematics._solver import (
    OPEN_M2,
    IkOptions,
    IkResult,
    solve_frames,
    tracking_error,
)

__all__ = [
    "OPEN_M2",
    "Band",
    "Fit",
    "IkOptions",
    "IkResult",
    "fit",
    "limits_of",
    "lower_equations",
    "slots_of",
    "solve_frames",
    "tracking_error",
]
