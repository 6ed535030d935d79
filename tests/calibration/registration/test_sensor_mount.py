"""Alignments of world and sensor are estimated if the movement determines them, else refused."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.calibration.registration import fit_observable_alignment, fit_sensor_alignment
from jointfit_daemon.kinematics import rotation as rot

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

DEG = np.deg2rad(1.0)
N = 600


def walk(rng: np.random.Generator, axis: tuple[float, ...] | None = None) -> Array:
    """Return orientations of a plate that is rotated by hand, about `axis` only if it is given."""
    steps = rng.normal(0, 0.08, (N, 3)) if axis is None else rng.normal(0, 0.08, (N, 1)) * axis
    q = np.empty((N, 4))
    q[0] = rot.IDENTITY
    for i, step in enumerate(rot.exp(steps[1:])):
        q[i + 1] = rot.multiply(q[i], step)
    return q


def body(q_s: Array, q_world: Array, q_mount: Array, noise: float = 0.0, seed: int = 9) -> Array:
    drawn = np.random.default_rng(seed).normal(0, 1, (N, 3)) * noise
    return rot.multiply(rot.multiply(rot.multiply(q_world, q_s), q_mount), rot.exp(drawn))


def off(a: Array, b: Array) -> float:
    return float(rot.angle_between(a, b))


def test_a_plate_turned_by_hand_determines_world_and_mount() -> None:
    rng = np.random.default_rng(0)
    q_s, q_world, q_mount = walk(rng), rot.exp([2.0, 0.3, -1.0]), rot.exp([-0.4, 1.5, 0.2])
    found = fit_observable_alignment(q_s, body(q_s, q_world, q_mount))
    assert found.kind == "full"
    assert found.refused == ()
    assert off(found.q_world, q_world) < 1e-7
    assert off(found.q_mount, q_mount) < 1e-7
    assert found.q_world[0] >= 0
    assert found.q_mount[0] >= 0


def test_signs_and_gaps_of_the_streams_do_not_matter() -> None:
    rng = np.random.default_rng(1)
    q_s, q_world, q_mount = walk(rng), rot.exp([2.0, 0.3, -1.0]), rot.exp([-0.4, 1.5, 0.2])
    q_body = body(q_s, q_world, q_mount)
    q_body *= rng.choice([-1.0, 1.0], N)[:, None]
    q_body[100:150] = np.nan
    found = fit_observable_alignment(q_s * rng.choice([-1.0, 1.0], N)[:, None], q_body)
    assert off(found.q_world, q_world) < 1e-7


def test_the_predicted_error_covers_the_actual_error() -> None:
    claimed, real = [], []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        q_s, q_world, q_mount = walk(rng), rot.exp(rng.normal(size=3)), rot.exp(rng.normal(size=3))
        found = fit_observable_alignment(q_s, body(q_s, q_world, q_mount, DEG, seed))
        claimed.append(found.weak_error)
        real.append(off(found.q_world, q_world))
    assert float(np.sqrt(np.mean(np.square(real)))) < 1.5 * float(np.mean(claimed))
    assert float(np.mean(claimed)) < 0.5 * DEG


def test_turning_about_one_level_axis_gives_the_heading_only() -> None:
    rng = np.random.default_rng(2)
    q_s, q_mount = walk(rng, (1.0, 0.0, 0.0)), rot.exp([0.3, 0.1, 0.2])
    found = fit_observable_alignment(q_s, body(q_s, rot.heading(1.1), q_mount, DEG))
    assert found.kind == "heading"
    assert float(rot.heading_of(found.q_world)) == pytest.approx(1.1, abs=0.5 * DEG)
    assert off(found.q_mount, q_mount) < 0.5 * DEG
    assert len(found.refused) == 1
    assert "two or more axes" in found.refused[0]


def test_rotation_about_the_vertical_does_not_determine_the_world() -> None:
    rng = np.random.default_rng(3)
    q_s, q_mount = walk(rng, (0.0, 0.0, 1.0)), rot.exp([0.3, 0.1, 0.2])
    found = fit_observable_alignment(q_s, body(q_s, rot.IDENTITY, q_mount, DEG))
    assert found.kind == "mount"
    assert np.array_equal(found.q_world, rot.IDENTITY)
    assert off(found.q_mount, q_mount) < 0.3 * DEG
    assert len(found.refused) == 2


def test_two_static_poses_do_not_determine_the_heading() -> None:
    poses = np.stack([rot.IDENTITY, rot.heading(1.5)])
    q_s = np.repeat(poses, N // 2, axis=0)
    assert (
        fit_observable_alignment(
            q_s, body(q_s, rot.heading(0.7), rot.exp([0.1, 0.2, 0.3]), DEG)
        ).kind
        == "mount"
    )


def test_a_heading_fit_never_tilts_the_world() -> None:
    rng = np.random.default_rng(4)
    q_s = walk(rng)
    tilted = fit_sensor_alignment("heading", q_s, body(q_s, rot.exp([0.2, 0.0, 0.9]), rot.IDENTITY))
    assert np.allclose(tilted.q_world[1:3], 0.0)


def test_outliers_do_not_rotate_the_world() -> None:
    rng = np.random.default_rng(5)
    q_s, q_world, q_mount = walk(rng), rot.exp([2.0, 0.3, -1.0]), rot.exp([-0.4, 1.5, 0.2])
    q_body = body(q_s, q_world, q_mount, DEG)
    wild = rng.random(N) < 0.2
    q_body[wild] = rot.normalize(rng.normal(size=(int(wild.sum()), 4)))
    found = fit_observable_alignment(q_s, q_body)
    assert found.kind == "full"
    assert off(found.q_world, q_world) < 0.4 * DEG
    assert found.residual_scale < 3 * DEG < found.residual_rms


def test_fewer_than_four_frames_are_refused() -> None:
    with pytest.raises(ValueError, match="four frames"):
        fit_observable_alignment(np.tile(rot.IDENTITY, (3, 1)), np.tile(rot.IDENTITY, (3, 1)))
