"""Results of a sensor calibration, as text and as JSON."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.calibration.inertial_sensor import (
    AccelerometerEstimate,
    GyroscopeEstimate,
    GyroscopeScaleEstimate,
    MagnetometerEstimate,
)

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.tools.calibrate_sensor._guided_steps import Estimate, SensorFindings


def report_lines(name: str, findings: SensorFindings) -> list[str]:
    """Return the errors of each step before and after the correction, as lines of text."""
    serial = "" if findings.serial is None else f" (serial {findings.serial})"
    lines = [f"{name}{serial}"]
    for estimate in findings.estimates.values():
        lines += _lines(estimate)
    lines += [
        f"  {name.replace('_', ' ')}: not estimated: {text}"
        for name, text in findings.not_estimated.items()
    ]
    lines += [f"  {step}: refused: {text}" for step, text in findings.refused.items()]
    lines += [f"  device: {text}" for text in findings.warnings]
    return lines


def _lines(estimate: Estimate) -> list[str]:
    if isinstance(estimate, GyroscopeEstimate):
        bias, sd = np.rad2deg(estimate.bias), np.rad2deg(estimate.bias_sd)
        return [
            f"  gyroscope: bias {_numbers(bias, 3)} deg/s, standard deviation "
            f"{sd.max():.4f}, from {estimate.rest_s:g} s at rest"
        ]
    scales = 100.0 * (1.0 / np.diag(estimate.matrix) - 1.0)
    scale_sd = 100.0 * np.diag(estimate.matrix_sd).max()
    common = f"scale errors {_numbers(scales, 2)} %, standard deviation {scale_sd:.2f}"
    if isinstance(estimate, GyroscopeScaleEstimate):
        off = np.abs(estimate.matrix - np.diag(np.diag(estimate.matrix))).max()
        axes = f"; axes {np.rad2deg(off):.2f} deg from the accelerometer axes"
        return [
            f"  gyroscope scale: errors {_numbers(scales, 2)} %, standard deviation "
            f"{scale_sd:.2f}{'' if np.isnan(estimate.matrix_sd[0, 1]) else axes}",
            f"    {estimate.turns} turns, {np.rad2deg(estimate.angle):.0f} deg in all; direction "
            f"of gravity wrong by {np.rad2deg(estimate.spread_before):.2f} deg (RMS) before "
            f"correction, {np.rad2deg(estimate.residual):.2f} after",
        ]
    if isinstance(estimate, AccelerometerEstimate):
        axes = "" if np.isnan(estimate.matrix_sd[0, 1]) else f"; axes {_axes(estimate.matrix)}"
        return [
            f"  accelerometer: bias {_numbers(estimate.bias, 3)} m/s², standard deviation "
            f"{estimate.bias_sd.max():.3f}; {common}{axes}",
            f"    |a| differs from gravity by {estimate.spread_before:.3f} m/s² (RMS) before "
            f"correction, {estimate.residual:.3f} after, in {estimate.poses} poses",
        ]
    missing = f"; missing directions: {', '.join(estimate.missing)}" if estimate.missing else ""
    return [
        f"  magnetometer: offset {_numbers(estimate.bias, 3)}, standard deviation "
        f"{estimate.bias_sd.max():.3f}, in a field of {estimate.magnitude:.3f} (unit of the "
        f"device); {common}; axes {_axes(estimate.matrix)}",
        f"    |m| varies by {100 * estimate.spread_before:.1f} % before correction, "
        f"{100 * estimate.residual:.1f} % after, in {estimate.readings} readings{missing}",
    ]


def report_data(name: str, findings: SensorFindings) -> dict[str, Any]:
    """Return the results as JSON data; arrays become lists, and unknown numbers become null."""
    parts = {part: asdict(estimate) for part, estimate in findings.estimates.items()}
    for part, estimate in findings.estimates.items():
        if isinstance(estimate, GyroscopeEstimate):
            parts[part]["bias_sd"] = estimate.bias_sd
        if isinstance(estimate, MagnetometerEstimate):
            parts[part]["missing"] = list(estimate.missing)
    return {
        "id": name,
        "serial": findings.serial,
        **parts,
        "not_estimated": findings.not_estimated,
        "refused": findings.refused,
        "warnings": findings.warnings,
    }


def _numbers(values: Array, digits: int) -> str:
    return " ".join(f"{value:.{digits}f}" for value in values)


def _axes(matrix: Array) -> str:
    """Return the largest deviation from a right angle between two axes, as text."""
    skew = np.rad2deg(np.abs(np.array((matrix[0, 1], matrix[0, 2], matrix[1, 2]))).max() * 2.0)
    return f"{skew:.2f} deg from perpendicular"
