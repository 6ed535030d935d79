"""Detection of rest, live and in recordings: simulated movements and a recorded board."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from bench.baselines.recorded_stillness import (
    RecordedStillnessLimits,
    still_from_orientation,
    still_from_rates,
)
from jointfit_daemon.calibration.registration import StillnessMonitor
from jointfit_daemon.kinematics import rotation as rot
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

RATE = 100.0
REST = slice(0, 500)  # 5 s at rest, then 5 s of swinging, then 1 s of rest, which is too short
SWING = slice(500, 1000)


def swinging() -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return rates with a bias, specific force, and orientations, 11 s at 100 Hz."""
    rng = np.random.default_rng(0)
    t = np.arange(1100) / RATE
    angle = np.where((t >= 5.0) & (t < 10.0), 0.5 * np.sin(2 * np.pi * (t - 5.0)), 0.0)
    bias = np.array([0.05, -0.02, 0.01])
    gyr = np.outer(np.gradient(angle, t), [1.0, 0.0, 0.0]) + bias
    q = rot.exp(np.outer(angle, [1.0, 0.0, 0.0]))
    acc = rot.rotate(rot.conjugate(q), [0.0, 0.0, 9.81])
    return gyr + rng.normal(0, 0.003, (1100, 3)), acc + rng.normal(0, 0.02, (1100, 3)), q


def jittered(q: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    noise = np.random.default_rng(1).normal(0, np.deg2rad(degrees), (len(q), 3))
    return rot.multiply(q, rot.exp(noise))


def verdicts(q: NDArray[np.float64], rate: float = RATE) -> NDArray[np.bool_]:
    monitor = StillnessMonitor()
    step = round(1e9 / rate)
    return np.array([monitor.feed(i * step, as_quaternion(row)) for i, row in enumerate(q)])


def test_rest_is_found_and_motion_is_not_rest() -> None:
    gyr, acc, q = swinging()
    for still in (still_from_rates(gyr, acc, RATE), still_from_orientation(q, RATE)):
        assert np.mean(still[REST]) > 0.88  # the half window before the movement does not count
        assert not still[SWING].any()


def test_rest_shorter_than_one_and_a_half_seconds_is_not_stillness() -> None:
    gyr, acc, _ = swinging()
    assert not still_from_rates(gyr, acc, RATE)[1000:].any()
    eager = still_from_rates(gyr, acc, RATE, RecordedStillnessLimits(shortest_s=0.1))
    assert eager[1060:].all()


def test_a_gyro_bias_is_no_movement() -> None:
    gyr, acc, _ = swinging()
    biased = gyr + np.array([9.0, -9.0, 5.0])
    assert np.array_equal(still_from_rates(gyr, acc, RATE), still_from_rates(biased, acc, RATE))


def test_linear_shaking_without_rotation_is_movement() -> None:
    gyr, acc, _ = swinging()
    shaken = acc + np.outer(0.3 * np.sin(np.arange(1100)), [1.0, 0.0, 0.0])
    assert not still_from_rates(gyr, shaken, RATE).any()


@pytest.mark.parametrize("rate", [20.0, 50.0, 100.0, 400.0])
def test_live_stillness_begins_after_one_window_and_ends_within_a_step(rate: float) -> None:
    turning = rot.exp(np.outer(np.arange(round(rate)) / rate, [0.0, 1.0, 0.0]))  # 1 rad/s
    q = np.concatenate([np.tile(rot.IDENTITY, (round(3 * rate), 1)), turning])
    told = verdicts(q, rate)
    first = int(np.argmax(told)) / rate
    assert first == pytest.approx(1.0, abs=0.11)
    assert told[int(1.2 * rate) : int(3 * rate)].all()
    assert not told[int(3.13 * rate) :].any()


def test_white_noise_of_a_third_of_a_degree_is_still() -> None:
    q = jittered(np.tile(rot.IDENTITY, (1000, 1)), 0.3)
    assert verdicts(q)[110:].mean() > 0.99
    assert still_from_orientation(q, RATE).mean() > 0.99


def test_a_slow_turn_over_the_limit_is_movement() -> None:
    slow = rot.exp(np.outer(np.arange(500) / RATE * np.deg2rad(1.5), [0.0, 0.0, 1.0]))
    assert not verdicts(slow).any()
    assert not still_from_orientation(slow, RATE).any()


def test_the_sign_of_a_quaternion_is_no_movement() -> None:
    q = np.tile(rot.IDENTITY, (400, 1)) * np.where(np.arange(400) % 2, -1.0, 1.0)[:, None]
    assert verdicts(q)[110:].all()
    assert still_from_orientation(q, RATE).all()


@pytest.mark.parametrize("jump_ns", [500_000_000, -500_000_000])
def test_a_pause_or_a_clock_that_ran_back_begins_a_new_window(jump_ns: int) -> None:
    monitor = StillnessMonitor()
    assert [monitor.feed(i * 10_000_000, (1.0, 0.0, 0.0, 0.0)) for i in range(200)][-1]
    assert not monitor.feed(1_990_000_000 + jump_ns, (1.0, 0.0, 0.0, 0.0))


def test_unknown_orientations_are_not_still() -> None:
    q = np.tile(rot.IDENTITY, (600, 1))
    q[300] = np.nan
    still = still_from_orientation(q, RATE)
    assert not still[300]
    assert still[50]
    assert not still_from_orientation(q[:50], RATE).any()  # the recording is shorter than a window


@pytest.mark.parametrize(
    "name", ["02_undisturbed_slow_rotation_B", "07_undisturbed_fast_rotation_B"]
)
def test_motion_of_a_recorded_board_is_never_stillness(shared_data: Path, name: str) -> None:
    with np.load(shared_data / "broad_excerpts" / f"{name}_60s.npz", allow_pickle=False) as trial:
        moving, rate = trial["movement"].astype(bool), float(trial["sampling_rate"])
        from_rates = still_from_rates(trial["imu_gyr"], trial["imu_acc"], rate)
        from_orientation = still_from_orientation(trial["opt_quat"], rate)
    assert from_rates[moving].mean() <= 0.002
    assert from_orientation[moving].mean() <= 0.01
    assert from_orientation[~moving].mean() > 0.6  # rests of 2 s lose half a window
