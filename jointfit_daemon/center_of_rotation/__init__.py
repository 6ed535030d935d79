"""Centers of rotation estimated from markers, body poses and joint angles."""

from jointfit_daemon.center_of_rotation._fused_estimate import fuse_centers
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
    "joint_trajectory",
    "refusal",
]
