"""Rotation fit, also at rotations for which columns of the adjugate matrix are zero."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.fusion._rotation_fit import fit_rotation

AXES = np.vstack([np.eye(3), [[1.0, 1.0, 0.0], [0.0, 1.0, -1.0], [1.0, 0.0, 1.0], [1.0, 1.0, 1.0]]])


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 90.0, 179.9999, 180.0])
@pytest.mark.parametrize("axis", AXES, ids=str)
@pytest.mark.parametrize("planar", [False, True], ids=["solid", "planar"])
def test_rotation_fit_agrees_with_scipy_about_every_axis(
    axis: np.ndarray, degrees: float, *, planar: bool
) -> None:
    points = np.random.default_rng(7).normal(0, 0.1, (5, 3)) * [1.0, 1.0, 0.0 if planar else 1.0]
    points -= points.mean(axis=0)
    turn = Rotation.from_rotvec(np.radians(degrees) * axis / np.linalg.norm(axis))
    turned = turn.apply(points)
    squares = float((points**2).sum())
    (a, b, c) = (tuple(row) for row in (points.T @ turned).tolist())

    q, largest = fit_rotation((a, b, c), squares)

    expected, _ = Rotation.align_vectors(turned, points)
    apart = Rotation.from_quat(q, scalar_first=True).inv() * expected
    assert np.degrees(apart.magnitude()) < 1e-5
    assert largest == pytest.approx(squares, rel=1e-12)
