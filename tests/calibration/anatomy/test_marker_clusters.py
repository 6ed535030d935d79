"""Rigid fits of marker clusters: three visible markers that are not on a line are sufficient."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.calibration import CalibrationError, CalibrationSettings, OpticalTrack
from jointfit_daemon.calibration.anatomy import moving_template, static_cluster, track_cluster
from jointfit_daemon.limb_model import is_line, rigid_fit, steady_fit

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.limb_model import MarkerCluster

SHIFT = np.array([1.0, 2.0, 1.0])
TEMPLATE = np.array([[0.1, 0, 0], [-0.05, 0.08, 0.02], [0, -0.07, 0.05], [0.02, 0.03, -0.1]])
TEMPLATE -= TEMPLATE.mean(axis=0)


def moved(rng: np.random.Generator, m: int = 60) -> tuple[Rotation, Array, Array]:
    R = Rotation.random(m, random_state=rng)
    t = rng.normal(0, 1, (m, 3))
    return R, t, np.einsum("mij,kj->mki", R.as_matrix(), TEMPLATE) + t[:, None]


def optical(
    positions: Array,
    names: tuple[str, ...] = ("T1", "T2", "T3", "T4"),
    bodies: tuple[str, ...] = (),
    body_q: Array | None = None,
    body_p: Array | None = None,
) -> OpticalTrack:
    m = len(positions)
    t = np.arange(m, dtype=np.int64) * 8_333_333
    body_p = np.zeros((m, 0, 3)) if body_p is None else body_p
    body_q = np.zeros((m, 0, 4)) if body_q is None else body_q
    return OpticalTrack(t, tuple(names), positions, tuple(bodies), body_p, body_q)


def apart(q: Array, R: Rotation) -> Array:
    wanted = R.as_quat(scalar_first=True)
    return np.asarray(2 * np.arccos(np.clip(np.abs((q * wanted).sum(axis=1)), 0, 1)))


@given(st.integers(0, 10_000), st.integers(0, 3))
def test_any_three_markers_of_four_give_the_pose(seed: int, hidden: int) -> None:
    R, t, y = moved(np.random.default_rng(seed), 5)
    y[:, hidden] = np.nan
    q, p, rms = rigid_fit(TEMPLATE, y)
    assert np.max(apart(q, R)) < 1e-7
    assert np.allclose(p, t, atol=1e-12)
    assert np.max(rms) < 1e-12


def test_cluster_with_two_markers_has_no_pose() -> None:
    _, _, y = moved(np.random.default_rng(0))
    y[10:20, :2] = np.nan
    q, p, rms = rigid_fit(TEMPLATE, y)
    assert np.isnan(q[10:20]).all()
    assert np.isnan(p[10:20]).all()
    assert np.isnan(rms[10:20]).all()
    assert np.isfinite(q[20:]).all()


def test_visible_markers_on_a_line_are_not_a_pose() -> None:
    template = np.array([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [0.1, 0.1, 0.0]])
    y = np.repeat(template[None], 4, axis=0)
    y[2:, 3] = np.nan
    assert np.isfinite(rigid_fit(template, y)[0]).all(axis=1).tolist() == [True, True, False, False]
    assert is_line(template[:3])


def test_a_heavier_marker_pulls_the_fit_towards_itself() -> None:
    y = TEMPLATE[None].copy()
    y[0, 0] += [0.02, 0.0, 0.0]
    gaps = []
    for weight in (1.0, 100.0):
        q, p, _ = rigid_fit(TEMPLATE, y, np.array([weight, 1.0, 1.0, 1.0]))
        fitted = Rotation.from_quat(q[0], scalar_first=True).apply(TEMPLATE) + p[0]
        gaps.append(np.linalg.norm(fitted[0] - y[0, 0]))
    assert gaps[1] < 0.2 * gaps[0]


def test_a_cluster_transforms_points_from_and_to_the_static_world() -> None:
    rng = np.random.default_rng(1)
    still = np.repeat(TEMPLATE[None] + SHIFT, 100, axis=0) + rng.normal(0, 1e-4, (100, 4, 3))
    settings = CalibrationSettings(markers={"thigh": ("T1", "T2", "T3", "T4")})
    cluster = static_cluster(optical(still), "thigh", settings)
    R, t, y = moved(rng)
    track = track_cluster(optical(y), cluster)
    point = np.array([0.01, -0.02, 0.3])
    truth = R.apply(point) + t
    static = point + SHIFT
    assert np.allclose(track.carry(static), truth, atol=2e-3)
    assert np.allclose(track.to_static(truth), static, atol=2e-3)
    assert np.allclose(track.to_static(y), cluster.template + cluster.origin, atol=2e-3)


def test_a_rigid_body_serves_as_a_cluster() -> None:
    rng = np.random.default_rng(2)
    m = 50
    q0 = Rotation.random(random_state=rng)
    still_q = np.repeat(q0.as_quat(scalar_first=True)[None, None], m, axis=0)
    still_p = np.ones((m, 1, 3))
    none = np.zeros((m, 0, 3))
    track = optical(none, (), ("Thigh",), still_q, still_p)
    settings = CalibrationSettings(rigid_bodies={"thigh": "Thigh"})
    cluster = static_cluster(track, "thigh", settings)
    R = Rotation.random(m, random_state=rng)
    q = (R * q0).as_quat(scalar_first=True)[:, None]
    moving = track_cluster(optical(none, (), ("Thigh",), q, still_p * 2), cluster)
    assert np.max(apart(moving.q, R)) < 1e-7
    assert np.allclose(moving.carry(np.array([1.0, 1.0, 1.0])), 2.0)


def test_a_swapped_label_is_not_taken_for_a_movement() -> None:
    _, _, y = moved(np.random.default_rng(3))
    settings = CalibrationSettings(markers={"thigh": ("T1", "T2", "T3", "T4")})
    still = np.repeat(TEMPLATE[None], 50, axis=0)
    cluster = static_cluster(optical(still), "thigh", settings)
    y[5, [0, 1]] = y[5, [1, 0]]
    track = track_cluster(optical(y), cluster)
    assert np.isnan(track.q[5]).all()
    assert np.isfinite(np.delete(track.q, 5, axis=0)).all()


def still_with(names: tuple[str, ...], positions: Array | None = None) -> MarkerCluster:
    positions = np.repeat(TEMPLATE[None], 50, axis=0) if positions is None else positions
    return static_cluster(
        optical(positions), "thigh", CalibrationSettings(markers={"thigh": names})
    )


def test_an_unknown_marker_is_refused_with_the_nearest_spelling() -> None:
    with pytest.raises(CalibrationError) as caught:
        still_with(("T1", "t2", "Q9"))
    text = str(caught.value)
    assert "'t2'" in text
    assert "did you mean 'T2'" in text
    assert "'Q9'" in text
    assert len(caught.value.reasons) == 2


def test_a_line_of_markers_and_hidden_markers_are_refused_with_a_remedy() -> None:
    line = np.array([[0, 0, 0.0], [0.1, 0, 0], [0.2, 0, 0], [0.3, 0, 0]])
    with pytest.raises(CalibrationError, match=r"on one line.*move one"):
        still_with(("T1", "T2", "T3"), np.repeat(line[None], 50, axis=0))
    hidden = np.repeat(TEMPLATE[None], 50, axis=0)
    hidden[5:, 1] = np.nan
    with pytest.raises(CalibrationError, match=r"T2 \(5 frames\)"):
        still_with(("T1", "T2", "T3"), hidden)
    with pytest.raises(CalibrationError, match="at least 3"):
        still_with(("T1", "T2"))


def test_a_template_is_learned_from_a_turning_plate() -> None:
    rng = np.random.default_rng(4)
    _, _, y = moved(rng, 300)
    y += rng.normal(0, 1e-3, y.shape)
    y[::3, 1] = np.nan
    y[0, 0] = np.nan
    found = moving_template(y)
    q, p, _ = rigid_fit(found, TEMPLATE[None])
    fitted = Rotation.from_quat(q[0], scalar_first=True).apply(found) + p[0]
    assert np.abs(fitted - TEMPLATE).max() < 5e-4


def test_an_intermittent_marker_causes_no_jump_in_spite_of_soft_tissue() -> None:
    rng = np.random.default_rng(5)
    shift = rng.normal(0, 0.008, TEMPLATE.shape)
    drift = np.linspace(0.5, 1.0, 120)[:, None, None]
    whole = TEMPLATE + shift * drift
    gappy = whole.copy()
    gappy[rng.uniform(size=120) < 0.2, 1] = np.nan
    gappy[[0, -1]] = whole[[0, -1]]
    q_whole, p_whole, _ = rigid_fit(TEMPLATE, whole)
    q_plain, _, _ = rigid_fit(TEMPLATE, gappy)
    q, p, _ = steady_fit(TEMPLATE, gappy)
    plain = (q_plain - q_whole)[np.isnan(gappy).any(axis=(1, 2))]
    assert np.abs(plain).max() > 5e-3  # a fit without interpolation jumps
    assert np.abs(q - q_whole).max() < 1e-5
    assert np.abs(p - p_whole).max() < 1e-5
