"""Predicted standard deviation of a hinge axis, compared with repeated simulated movements."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from jointfit_daemon.center_of_rotation import hinge_axis_sd

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

AXIS = np.array([0.0, 0.6, 0.8])
MARKERS = np.array([[0.2, 0.0, 0.05], [0.15, 0.06, -0.1], [0.25, -0.05, 0.02]])


def paths(rng: np.random.Generator, *, frames: int = 300, correlation: float = 0.0) -> Array:
    """Return markers on a hinge with 1 mm of noise, correlated from frame to frame."""
    turned = Rotation.from_rotvec(np.outer(0.8 * np.sin(np.linspace(0.0, 20.0, frames)), AXIS))
    still = np.stack([turned.apply(marker) for marker in MARKERS], axis=1)
    white = rng.normal(0.0, 1e-3 * np.sqrt(1.0 - correlation**2), still.shape)
    return np.asarray(still + lfilter([1.0], [1.0, -correlation], white, axis=0))


def normal(points: Array) -> Array:
    away = (points - points.mean(axis=0)).reshape(-1, 3)
    found = np.linalg.svd(away, full_matrices=False)[2][2]
    return np.asarray(found * np.sign(found @ AXIS))


def test_the_stated_deviation_is_that_of_repeated_movements() -> None:
    rng = np.random.default_rng(1)
    for correlation in (0.0, 0.8):
        errors, stated = [], []
        for _ in range(150):
            points = paths(rng, correlation=correlation)
            found = normal(points)
            errors.append(np.linalg.norm(np.cross(found, AXIS)) / np.sqrt(2.0))
            stated.append(hinge_axis_sd(points, found))
        ratio = np.sqrt(np.mean(np.square(errors))) / np.mean(np.array(stated, dtype=float))
        assert 0.8 < ratio < 1.25, correlation


def test_missing_markers_are_left_out() -> None:
    points = paths(np.random.default_rng(2))
    whole = hinge_axis_sd(points, AXIS)
    points[::2, 1] = np.nan
    points[:, 2] = np.nan
    part = hinge_axis_sd(points, AXIS)
    assert whole is not None
    assert part is not None
    assert 1.2 * whole < part < 2.5 * whole


def test_without_an_axis_or_a_path_there_is_no_deviation() -> None:
    points = paths(np.random.default_rng(3))
    assert hinge_axis_sd(points, None) is None
    assert hinge_axis_sd(points * np.nan, AXIS) is None
