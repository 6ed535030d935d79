"""Series accept consistent arrays only; resampling keeps rows and bridges no gap."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from jointfit_daemon.session_data import (
    JointSeries,
    MarkerSeries,
    SegmentSeries,
    SensorSeries,
    SessionData,
    SessionDataError,
    TimelineEvent,
    interpolate_orientations,
    interpolate_values,
    is_uniform,
    sample_rate_hz,
    uniform_times,
)

T_S = np.arange(5) / 10.0
UNIT = np.tile([1.0, 0.0, 0.0, 0.0], (5, 1))


def test_a_session_lists_all_time_axes() -> None:
    late = T_S + 2.0
    session = SessionData(
        "walk",
        sensors=(SensorSeries("S1", "thigh", T_S, UNIT),),
        markers=MarkerSeries(("A",), late, np.zeros((5, 1, 3))),
        joints=(JointSeries("knee", T_S, {"flexion": T_S}),),
    )
    assert len(list(session.time_axes())) == 3
    assert session.duration_s == pytest.approx(2.4)


@pytest.mark.parametrize(
    ("t_s", "words"),
    [
        (np.array([0.0, 0.2, 0.1, 0.3, 0.4]), "row 2 .* to row 3"),
        (np.array([0.0, 0.1, 0.1, 0.3, 0.4]), "row 2 .* to row 3"),
        (np.array([0.0, 0.1, np.nan, 0.3, 0.4]), "row 3 has no time"),
        (np.arange(5), "float64"),
        (T_S[:4], r"\(5, 4\), expected \(4, 4\)"),
    ],
)
def test_wrong_times_are_refused_with_the_row(t_s: np.ndarray, words: str) -> None:
    with pytest.raises(SessionDataError, match=f"sensor 'S1'.*{words}"):
        SensorSeries("S1", "", t_s, UNIT)


@pytest.mark.parametrize("row", [[2.0, 0, 0, 0], [0, 0, 0, 0], [1.0, 0, 0, np.nan]])
def test_a_quaternion_is_of_unit_length_or_unknown(row: list[float]) -> None:
    q = UNIT.copy()
    q[2] = np.nan
    SegmentSeries("thigh", T_S, q)
    q[3] = row
    with pytest.raises(SessionDataError, match="row 4"):
        SegmentSeries("thigh", T_S, q)


def test_names_are_unique_and_events_in_order() -> None:
    knee = JointSeries("knee", T_S)
    with pytest.raises(SessionDataError, match="'knee' occurs more than once"):
        SessionData("walk", joints=(knee, knee))
    with pytest.raises(SessionDataError, match="'A' occurs"):
        MarkerSeries(("A", "A"), T_S, np.zeros((5, 2, 3)))
    with pytest.raises(SessionDataError, match="order"):
        SessionData("walk", events=(TimelineEvent(2.0, "mark"), TimelineEvent(1.0, "mark")))
    with pytest.raises(SessionDataError, match="without the angle"):
        JointSeries("knee", T_S, {}, {"flexion": T_S})


def test_rate_and_uniformity_of_an_axis() -> None:
    assert sample_rate_hz(T_S) == pytest.approx(10.0)
    assert is_uniform(T_S + 1e-5)
    assert not is_uniform(np.delete(T_S, 2))
    assert uniform_times([T_S, T_S]) is T_S


def test_a_common_axis_has_the_highest_rate_and_the_whole_range() -> None:
    common = uniform_times([T_S, 0.05 + np.arange(20) / 20.0])
    np.testing.assert_allclose(common, np.arange(21) / 20.0, atol=1e-12)


@given(st.floats(0.0, 0.4), st.integers(0, 2**32 - 1))
def test_interpolation_agrees_with_an_independent_slerp(at: float, seed: int) -> None:
    q = Rotation.random(5, rng=np.random.default_rng(seed))
    found = interpolate_orientations(T_S, q.as_quat(scalar_first=True), np.array([at]))
    expected = Slerp(T_S, q)([at])
    apart = Rotation.from_quat(found, scalar_first=True) * expected.inv()
    # A half turn has two shortest rotations, and both are correct.
    steps = (q[1:] * q[:-1].inv()).magnitude()
    assert apart.magnitude() < 1e-6 or steps.max() > np.pi - 1e-3


def test_rows_are_kept_and_gaps_are_not_bridged() -> None:
    t_s = np.array([0.0, 0.1, 0.2, 0.5, 0.6])
    values = np.array([0.0, 1.0, np.nan, 5.0, 6.0])
    at = np.array([-0.1, 0.0, 0.05, 0.1, 0.15, 0.2, 0.35, 0.5, 0.55, 0.6, 0.61])
    nan = np.nan
    np.testing.assert_allclose(
        interpolate_values(t_s, values, at), [nan, 0, 0.5, 1, nan, nan, nan, 5, 5.5, 6, nan]
    )
    assert np.isnan(interpolate_values(np.empty(0), np.empty((0, 3)), at)).all()


@pytest.mark.parametrize("period_s", [0.1, 100.0])
def test_a_row_within_a_millionth_of_a_period_is_kept(period_s: float) -> None:
    t_s, values = period_s * np.arange(3.0), np.array([np.nan, 1.0, np.nan])
    at = period_s * np.array([1.0 - 1e-5, 1.0 - 5e-7, 1.0, 1.0 + 5e-7, 1.0 + 1e-5])
    found = interpolate_values(t_s, values, at)
    assert np.isfinite(found).tolist() == [False, True, True, True, False]
    assert (found[1:4] == 1.0).all()
