"""Guidance of the functional movement: progress, missing movements and instructions."""

from jointfit_daemon.calibration.guidance._live_joint_centers import (
    LiveJointCenter,
    LiveJointCenters,
)
from jointfit_daemon.calibration.guidance._movement_guide import (
    MovementGuide,
    MovementStatus,
    most_urgent,
)

__all__ = ["LiveJointCenter", "LiveJointCenters", "MovementGuide", "MovementStatus", "most_urgent"]
