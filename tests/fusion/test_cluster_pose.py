"""Cluster poses of single frames, compared with the independent fit of a whole trial."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.fusion._cluster_pose import ClusterPose
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import MAX_FIT_RMS_M, MarkerCluster, rigid_fit
from jointfit_daemon.model import MocapFrame, MocapLayout

NAMES = ("a", "b", "c", "d", "e")
LAYOUT = MocapLayout(("x", *reversed(NAMES)), ("other", "Pelvis"))
POINT = np.array([0.3, -0.1, 0.9])


def cluster(template: np.ndarray, body: str | None = None) -> MarkerCluster:
    origin = np.array([0.2, 0.1, 1.0])
    q = rotation.exp(np.array([0.3, 0.2, -0.4]))
    return MarkerCluster("pelvis", () if body else NAMES, body, template, origin, q)


def seen(positions: np.ndarray) -> MocapFrame:
    markers = np.concatenate([np.full((1, 3), 9.0), positions[::-1]])
    bodies = np.full((2, 3), np.nan), np.full((2, 4), np.nan)
    return MocapFrame(0, 1, None, LAYOUT, markers, *bodies)


@given(
    st.integers(0, 2**32 - 1),
    st.lists(st.booleans(), min_size=5, max_size=5),
    st.sampled_from([1.0, 0.001, 0.0]),
    st.sampled_from([0.0, 0.002, 0.02, 0.2]),
)
def test_pose_agrees_with_the_fit_of_a_trial(
    seed: int, hidden: list[bool], thickness: float, scatter: float
) -> None:
    rng = np.random.default_rng(seed)
    template = rng.normal(0, 0.08, (5, 3)) * [1.0, thickness, 1.0]
    turn = Rotation.random(random_state=rng)
    positions = turn.apply(template) + rng.normal(size=3) + rng.normal(0, scatter, (5, 3))
    positions[hidden] = np.nan
    part = cluster(template)
    found = ClusterPose(part, POINT[None], LAYOUT).fit(seen(positions))
    q, t, rms = (each[0] for each in rigid_fit(template, positions[None]))
    if not rms <= MAX_FIT_RMS_M:
        assert found is None
    else:
        assert found is not None
        expected = rotation.rotate(q, POINT - part.origin) + t
        np.testing.assert_allclose(found.points[0], expected, atol=1e-6)
        np.testing.assert_allclose(rotation.to_matrix(found.q), rotation.to_matrix(q), atol=1e-6)


def test_markers_are_tuples_as_compiled_code_requires() -> None:
    pose = ClusterPose(cluster(np.eye(5, 3)), POINT[None], LAYOUT)
    subset = pose._all
    assert subset is not None
    assert {type(row) for row in (*subset.centered, *subset.offsets)} == {tuple}


def test_rigid_body_moves_the_points() -> None:
    part = cluster(np.eye(3), body="Pelvis")
    frame = seen(np.zeros((5, 3)))
    pose = ClusterPose(part, POINT[None], LAYOUT)
    assert pose.fit(frame) is None
    frame.body_positions[1], frame.body_orientations[1] = part.origin, part.q_body
    fitted = pose.fit(frame)
    assert fitted is not None
    assert fitted.points[0] == pytest.approx(tuple(POINT))
    turned = Rotation.from_euler("z", 90, degrees=True)
    body = turned * Rotation.from_quat(part.q_body, scalar_first=True)
    frame.body_orientations[1] = body.as_quat(scalar_first=True)
    expected = turned.apply(POINT - part.origin) + part.origin
    fitted = pose.fit(frame)
    assert fitted is not None
    assert fitted.points[0] == pytest.approx(tuple(expected))
    np.testing.assert_allclose(rotation.to_matrix(fitted.q), turned.as_matrix(), atol=1e-12)


def test_stream_without_markers_or_body_gives_none() -> None:
    frame = seen(np.zeros((5, 3)))
    bare = MocapLayout(NAMES[:-1], ("other",))
    for part in (cluster(np.eye(5, 3)), cluster(np.eye(3), body="Pelvis")):
        assert ClusterPose(part, POINT[None], bare).fit(frame) is None
