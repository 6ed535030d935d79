"""A complete calibration of any chain without models, like the result of a static pose."""

from __future__ import annotations

from typing import Any

from jointfit_daemon.limb_model import (
    Calibration,
    JointCalibration,
    SegmentCalibration,
    SensorCalibration,
)

UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def plain_calibration(chain: Any, **changed: Any) -> Calibration:
    """Return a calibration of `chain`, or of the names in `changed`."""
    parts: dict[str, Any] = {
        "joints": chain.joints, "segments": chain.segments, "chain_sensors": chain.sensors,
    } | changed  # fmt: skip
    worn = [name for group in parts["chain_sensors"] for name in group]
    return Calibration(
        method="mean",
        sensor={name: SensorCalibration(UPRIGHT, UPRIGHT) for name in worn},
        segment={name: SegmentCalibration(UPRIGHT, None, None) for name in parts["segments"]},
        joint={name: JointCalibration(None, None, "unknown") for name in parts["joints"]},
        **parts,
    )
