"""Simulated sensor faults: stuck output, slip and heading drift."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_simulators.devices import SensorFaults
from jointfit_simulators.devices._sensor_faults import SLIP_S

T_S = np.arange(0.0, 4.0, 0.01)
MEASURED = Rotation.from_rotvec(
    np.stack((np.sin(3 * T_S), 0.3 * T_S, 0.1 * np.cos(T_S)), axis=1)
).as_quat(scalar_first=True)


def blocks(
    faults: SensorFaults, first: int, end: int, measured: np.ndarray = MEASURED
) -> np.ndarray:
    """Return the orientations with faults, applied in blocks of 0.2 s."""
    cuts = [slice(k, min(k + 20, end)) for k in range(first, end, 20)]
    return np.concatenate([faults.apply(T_S[cut], measured[cut]) for cut in cuts])


def rotations(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


def test_without_faults_orientations_are_unchanged() -> None:
    assert np.array_equal(blocks(SensorFaults(), 0, 400), MEASURED)


def test_stuck_sensor_repeats_its_output_exactly_until_freed() -> None:
    faults = SensorFaults()
    blocks(faults, 0, 100)
    faults.stick()
    assert np.all(blocks(faults, 100, 200) == MEASURED[100])
    faults.free()
    assert np.array_equal(blocks(faults, 200, 300), MEASURED[200:300])


def test_slips_accumulate_and_remain() -> None:
    faults = SensorFaults()
    blocks(faults, 0, 100)
    faults.slip(0.2)
    first = rotations(MEASURED[100:200]).inv() * rotations(blocks(faults, 100, 200))
    angles = np.atleast_1d(first.magnitude())
    assert angles[0] == pytest.approx(0.2 * 0.01 / SLIP_S, rel=1e-6)
    assert np.all(np.diff(angles) > -1e-9)
    assert angles[-1] == pytest.approx(0.2)
    faults.slip(-0.2)
    assert np.allclose(blocks(faults, 200, 300)[-50:], MEASURED[250:300])


def test_drift_rotates_about_the_vertical_and_stops_at_its_heading() -> None:
    faults = SensorFaults()
    blocks(faults, 0, 100)
    faults.drift(0.5)
    blocks(faults, 100, 300)
    faults.drift(0.0)
    turned = rotations(blocks(faults, 300, 400)) * rotations(MEASURED[300:400]).inv()
    assert np.allclose(turned.as_rotvec(), [0.0, 0.0, 0.5 * 2.0])


def test_missing_samples_remain_missing() -> None:
    gaps = MEASURED.copy()
    gaps[::7] = np.nan
    faults = SensorFaults()
    faults.slip(0.3)
    faults.stick()
    measured = blocks(faults, 0, 100, gaps)
    assert np.array_equal(np.isnan(measured[:, 0]), np.isnan(gaps[:100, 0]))
