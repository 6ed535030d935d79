"""Guidance of the functional movement: progress, missing movements and instructions."""

from jointfit_daemon.calibration.guidance._movement_guide import (
    MovementGuide,
    MovementLook,
    first_of,
)

__all__ = ["MovementGuide", "MovementLook", "first_of"]
