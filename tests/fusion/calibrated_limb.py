"""A synthetic subject with a full calibration, for tests of fusion."""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.calibration.phases import fit_calibration, fit_plate_alignment
from tests.calibration.synthetic_limb import (
    CHAIN,
    SETTINGS,
    plate_trial,
    static_and_functional,
)

if TYPE_CHECKING:
    from jointfit_daemon.calibration import CalibrationSettings
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Chain
    from tests.calibration.synthetic_limb import Subject


def calibrated(
    subject: Subject, chain: Chain = CHAIN, settings: CalibrationSettings = SETTINGS
) -> Calibration:
    """Return the calibration from align phase, static pose and 30 s of movement."""
    static, functional, _ = static_and_functional(subject, 30.0)
    alignment = fit_plate_alignment(plate_trial(subject), settings)
    return fit_calibration(static, functional, alignment, settings, chain)
