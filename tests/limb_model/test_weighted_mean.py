"""The weighted mean of sensors: closed form against eigenvectors, one frame against arrays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.calibration.soft_tissue import fusion_weights
from jointfit_daemon.kinematics import rotation as rot
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion, normalize_one
from jointfit_daemon.limb_model import fuse, fuse_one

Quaternion = tuple[float, float, float, float]
parts = st.floats(-1.0, 1.0)
quaternions = (
    st.tuples(parts, parts, parts, parts)
    .filter(lambda q: sum(c * c for c in q) > 0.01)
    .map(normalize_one)
)
weights = st.floats(0.05, 20.0)


@given(quaternions, quaternions, weights, weights)
def test_two_sensors_in_closed_form_are_the_eigenvector(
    p: Quaternion, q: Quaternion, a: float, b: float
) -> None:
    found = fuse_one((p, q), (a, b))
    M = a * np.outer(p, p) + b * np.outer(q, q)
    # Compare the quadratic form: the eigenvector is ill-conditioned for almost opposite p, q.
    assert np.array(found) @ M @ np.array(found) == pytest.approx(
        np.linalg.eigvalsh(M)[-1], rel=1e-12
    )
    assert np.allclose(fuse([np.array([p]), np.array([q])], (a, b))[0], found, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 3, 4])
def test_fusion_frame_by_frame_equals_fusion_of_arrays(count: int) -> None:
    rng = np.random.default_rng(count)
    truth = rot.normalize(rng.normal(size=(50, 4)))
    sensors = [rot.multiply(truth, rot.exp(rng.normal(0, 0.1, (50, 3)))) for _ in range(count)]
    share = rng.uniform(0.2, 1.0, count).tolist()
    array = fuse(sensors, share)
    for i in range(50):
        one = fuse_one([as_quaternion(q[i]) for q in sensors], share)
        assert rot.angle_between(one, array[i]) < 1e-9


def test_the_better_sensor_weighs_more_in_proportion_to_its_precision() -> None:
    rng = np.random.default_rng(0)
    truth = rot.normalize(rng.normal(size=(4000, 4)))
    sensors = [rot.multiply(truth, rot.exp(rng.normal(0, sd, (4000, 3)))) for sd in (0.1, 0.2)]
    found = fusion_weights(sensors, truth)
    assert found.sum() == pytest.approx(1.0)
    assert found[0] / found[1] == pytest.approx(4.0, rel=0.1)
    assert np.isfinite(fusion_weights([truth, truth], truth)).all()
