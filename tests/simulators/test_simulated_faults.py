"""Sensors that stick, slip and drift say so much and no more, and the truth stays as it was."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_simulators.devices import SensorFaults
from jointfit_simulators.devices._sensor_faults import SLIP_S

T_S = np.arange(0.0, 4.0, 0.01)
SAID = Rotation.from_rotvec(
    np.stack((np.sin(3 * T_S), 0.3 * T_S, 0.1 * np.cos(T_S)), axis=1)
).as_quat(scalar_first=True)


def blocks(mishaps: SensorFaults, first: int, end: int, said: np.ndarray = SAID) -> np.ndarray:
    """Return what is said instead, a fifth of a second at a time."""
    cuts = [slice(k, min(k + 20, end)) for k in range(first, end, 20)]
    return np.concatenate([mishaps.apply(T_S[cut], said[cut]) for cut in cuts])


def rotations(q: np.ndarray) -> Rotation:
    return Rotation.from_quat(q, scalar_first=True)


def test_samples_without_a_fault_are_unchanged() -> None:
    assert np.array_equal(blocks(SensorFaults(), 0, 400), SAID)


def test_a_stuck_sensor_repeats_itself_to_the_bit_until_it_is_freed() -> None:
    mishaps = SensorFaults()
    blocks(mishaps, 0, 100)
    mishaps.stick()
    assert np.all(blocks(mishaps, 100, 200) == SAID[100])
    mishaps.free()
    assert np.array_equal(blocks(mishaps, 200, 300), SAID[200:300])


def test_slips_add_up_and_stay() -> None:
    mishaps = SensorFaults()
    blocks(mishaps, 0, 100)
    mishaps.slip(0.2)
    first = rotations(SAID[100:200]).inv() * rotations(blocks(mishaps, 100, 200))
    angles = np.atleast_1d(first.magnitude())
    assert angles[0] == pytest.approx(0.2 * 0.01 / SLIP_S, rel=1e-6)
    assert np.all(np.diff(angles) > -1e-9)
    assert angles[-1] == pytest.approx(0.2)
    mishaps.slip(-0.2)
    assert np.allclose(blocks(mishaps, 200, 300)[-50:], SAID[250:300])


def test_a_drift_turns_the_world_about_the_vertical_and_stops_where_it_is() -> None:
    mishaps = SensorFaults()
    blocks(mishaps, 0, 100)
    mishaps.drift(0.5)
    blocks(mishaps, 100, 300)
    mishaps.drift(0.0)
    turned = rotations(blocks(mishaps, 300, 400)) * rotations(SAID[300:400]).inv()
    assert np.allclose(turned.as_rotvec(), [0.0, 0.0, 0.5 * 2.0])


def test_missing_samples_remain_missing_under_faults() -> None:
    holes = SAID.copy()
    holes[::7] = np.nan
    mishaps = SensorFaults()
    mishaps.slip(0.3)
    mishaps.stick()
    said = blocks(mishaps, 0, 100, holes)
    assert np.array_equal(np.isnan(said[:, 0]), np.isnan(holes[:100, 0]))
