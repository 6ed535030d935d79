"""Guidance of the functional movement: progress, missing movements and instructions."""

from jointfit_daemon.calibration.guidance._movement_guide import (
    MovementGuide,
    MovementStatus,
    most_urgent,
)

__all__ = ["MovementGuide", "MovementStatus", "most_urgent"]
