"""Centers of rotation estimated from markers, body poses and joint angles."""

from jointfit_daemon.center_of_rotation._fused_estimate import fuse_centers
from jointfit_daemon.center_of_rotation._hinge_axis import hinge_axis_sd
from jointfit_daemon.center_of_rotation._joint_trajectory import (
    JointSide,
    JointTrajectory,
    joint_trajectory,
)
from jointfit_daemon.center_of_rotation._methods import METHODS, estimate_center
from jointfit_daemon.center_of_rotation._movement import BodyPoses, Movement
from jointfit_daemon.center_of_rotation._result import CenterEstimate, refusal

__all__ = [
    "METHODS",
    "BodyPoses",
    "CenterEstimate",
    "JointSide",
    "JointTrajectory",
    "Movement",
    "estimate_center",
    "fuse_centers",
    "hinge_axis_sd",
    "joint_trajectory",
    "refusal",
]
