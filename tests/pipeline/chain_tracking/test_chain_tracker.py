"""A chain model follows the markers of the cameras and excludes faulty markers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.files.models import LoadedModel
from jointfit_daemon.kinematics.chain_coordinates import default_coordinates
from jointfit_daemon.kinematics.chains import ChainModel, Joint, Marker, Segment
from jointfit_daemon.model import ChainModelState, MocapFrame, MocapLayout
from jointfit_daemon.pipeline.chain_tracking import ChainTracker
from jointfit_daemon.pipeline.events import Notice
from tests.calibration.synthetic_limb import LOCAL, MARKERS

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.arrays import Array

RATE_HZ = 10.0
NAMES = tuple(name for part in LOCAL for name in MARKERS[part])


def model() -> ChainModel:
    """Return pelvis and leg of the synthetic subject; the knee is a hinge."""
    return ChainModel(
        (
            Segment("pelvis"),
            Segment("thigh", "pelvis", Joint("ball")),
            Segment("shank", "thigh", Joint("hinge", (0.0, 0.0, -0.42))),
            Segment("foot", "shank", Joint("ball", (0.0, 0.0, -0.40))),
        ),
        tuple(
            Marker(name, part, (x, y, z))
            for part, local in LOCAL.items()
            for name, (x, y, z) in zip(MARKERS[part], local, strict=True)
        ),
        "leg",
    )


def angles(t_s: float) -> tuple[float, float]:
    """Return hip and knee flexion of a slow walk, deg."""
    return 25.0 * np.sin(3.0 * t_s), 30.0 - 30.0 * np.cos(3.0 * t_s)


def markers(t_s: float) -> Array:
    """Return markers computed with SciPy's rotations, m, shape (16, 3), in the order of NAMES."""
    hip, knee = angles(t_s)
    pelvis = Rotation.from_euler("z", 40.0 + 5.0 * t_s, degrees=True)
    thigh = pelvis * Rotation.from_euler("XYZ", (hip, 5.0, -3.0), degrees=True)
    shank = thigh * Rotation.from_euler("x", -knee, degrees=True)
    hips = np.array([0.3 * t_s, 0.1, 0.9])
    knees = hips + thigh.apply([0, 0, -0.42])
    ankles = knees + shank.apply([0, 0, -0.40])
    bones = {
        "pelvis": (pelvis, hips), "thigh": (thigh, hips), "shank": (shank, knees),
        "foot": (shank, ankles),
    }  # fmt: skip
    placed = [bones[part][0].apply(LOCAL[part]) + bones[part][1] for part in LOCAL]
    return np.concatenate(placed) + np.random.default_rng(int(1e3 * t_s)).normal(0, 1e-3, (16, 3))


def track(
    seconds: float,
    change: Callable[[float, Array], Array] = lambda _, points: points,
    rate_hz: float = RATE_HZ,
    *,
    covariance: bool = False,
) -> tuple[list[ChainModelState], list[Notice]]:
    """Return states and notices of frames at 50 Hz."""
    loaded = LoadedModel(model(), default_coordinates(model()))
    tracker = ChainTracker(loaded, rate_hz, covariance=covariance)
    states: list[ChainModelState] = []
    notices: list[Notice] = []
    layout = MocapLayout(NAMES, ())
    for k in range(round(50 * seconds)):
        points = change(k / 50, markers(k / 50))
        frame = MocapFrame(0, k, None, layout, points, np.zeros((0, 3)), np.zeros((0, 4)))
        for output in tracker.add_frame(k * 20_000_000, frame):
            if isinstance(output, ChainModelState):
                states.append(output)
            elif isinstance(output, Notice):
                notices.append(output)
    return states, notices


def coordinate(state: ChainModelState, name: str) -> tuple[float | None, float | None]:
    one = next(c for c in state.coordinates if c.name == name)
    return one.value, one.sd


def flexion_errors_deg(states: list[ChainModelState]) -> Array:
    found = [coordinate(state, "shank_angle")[0] for state in states]
    expected = [-angles(state.t_ns / 1e9)[1] for state in states]
    return np.asarray(np.degrees(np.array(found, dtype=float)) - expected)


def replaced(name: str, by: Callable[[float, Array], Array]) -> Callable[[float, Array], Array]:
    def change(t_s: float, points: Array) -> Array:
        points[NAMES.index(name)] = by(t_s, points)
        return points

    return change


def exchange(first: str, second: str, until_s: float) -> Callable[[float, Array], Array]:
    i, j = NAMES.index(first), NAMES.index(second)

    def change(t_s: float, points: Array) -> Array:
        if t_s < until_s:
            points[[i, j]] = points[[j, i]]
        return points

    return change


def test_coordinates_follow_the_movement_within_their_standard_deviations() -> None:
    states, notices = track(6.0)
    assert notices == []
    assert len(states) == pytest.approx(6 * RATE_HZ, abs=1)
    errors = flexion_errors_deg(states)
    sd = np.degrees([coordinate(state, "shank_angle")[1] or np.nan for state in states])
    assert np.abs(errors).max() < 1.5
    assert np.mean(np.abs(errors[10:]) < 1.96 * sd[10:]) > 0.85
    assert np.sqrt(np.mean((errors[10:] / sd[10:]) ** 2)) > 0.6
    assert all(state.flags == () for state in states)
    last = states[-1]
    assert last.fit is not None
    assert last.fit.accepted
    assert last.recent is not None
    assert 0.0012 < last.recent.rms < 0.002
    assert last.recent.maximum >= last.fit.maximum
    assert set(last.errors) == set(NAMES)


def test_covariance_contains_the_coordinates_with_a_value() -> None:
    def hide_foot(t_s: float, points: Array) -> Array:
        points[13:] = np.nan if t_s > 1.0 else points[13:]
        return points

    states, _ = track(2.0, hide_foot, covariance=True)
    for state in states:
        known = [one for one in state.coordinates if one.value is not None]
        assert state.covariance is not None
        assert np.shape(state.covariance) == (len(known), len(known))
        sd = np.sqrt(np.diagonal(state.covariance)).tolist()
        assert sd == pytest.approx([one.sd for one in known])
    first, last = states[0].covariance, states[-1].covariance
    assert first is not None
    assert last is not None
    assert (len(first), len(last)) == (13, 10)


def test_a_marker_that_is_lost_for_minutes_is_flagged_and_the_rest_continues() -> None:
    hidden = replaced("thigh1", lambda t_s, p: p[5] if t_s < 2 or t_s > 15 else np.full(3, np.nan))
    states, notices = track(17.0, hidden)
    during = [s for s in states if 3.2 < s.t_ns / 1e9 < 15.0]
    assert all(s.flags == ("lost:thigh1",) and s.errors["thigh1"] is None for s in during)
    assert np.abs(flexion_errors_deg(during)).max() < 2.0
    assert [(n.id, n.data["state"]) for n in notices] == [("thigh1", "lost"), ("thigh1", "ok")]
    assert states[-1].flags == ()


def test_exchanged_markers_are_excluded_until_their_labels_are_correct() -> None:
    states, notices = track(12.0, exchange("thigh0", "thigh3", 6.0))
    assert [(n.id, n.data["state"]) for n in notices] == [("thigh0", "exchanged"), ("thigh0", "ok")]
    assert notices[0].data["markers"] == ["thigh0", "thigh3"]
    during = [s for s in states if 3.0 < s.t_ns / 1e9 < 6.0]
    assert all(s.flags == ("exchanged:thigh0~thigh3",) for s in during)
    assert np.abs(flexion_errors_deg(during)).max() < 2.0
    assert all(s.fit is not None and s.fit.accepted for s in during)
    assert during[0].errors["thigh0"] == pytest.approx(0.16, abs=0.03)
    assert states[-1].flags == ()


@pytest.mark.parametrize("labels", [("thigh0", "thigh1", "thigh2"), ("thigh0", "shank1", "foot0")])
def test_three_exchanged_labels_are_named_together_each_with_its_place(
    labels: tuple[str, str, str],
) -> None:
    rows = [NAMES.index(name) for name in labels]

    def rotate(_: float, points: Array) -> Array:
        points[rows] = points[rows[1:] + rows[:1]]  # each label is at the next label's place
        return points

    states, (notice,) = track(3.0, rotate)
    assert states[-1].flags == (f"exchanged:{'~'.join(labels)}",)
    assert notice.data["markers"] == list(labels)
    a, b, c = labels
    assert f"{a} is at the place of {b}, {b} is at the place of {c} and {c} is" in notice.text
    assert np.abs(flexion_errors_deg(states[15:])).max() < 2.0


@pytest.mark.parametrize(
    "labels",
    [
        ("foot0", "foot1", "foot2"),
        ("foot0", "foot3", "foot1"),
        ("pelvis0", "pelvis1", "pelvis2"),
        ("foot0", "foot1", "foot2", "foot3"),
    ],
    ids="-".join,
)
def test_cycled_labels_at_the_ends_of_the_chain_are_named_by_their_shape_until_correct(
    labels: tuple[str, ...],
) -> None:
    rows = [NAMES.index(name) for name in labels]

    def rotate(t_s: float, points: Array) -> Array:
        if t_s < 4.0:
            points[rows] = points[rows[1:] + rows[:1]]
        return points

    states, notices = track(9.0, rotate)
    assert [(n.data["state"], n.data["markers"]) for n in notices] == [
        ("exchanged", list(labels)), ("ok", list(labels)),
    ]  # fmt: skip
    assert states[-1].flags == ()


@pytest.mark.parametrize("labels", [("thigh0", "thigh3"), ("thigh0", "shank1", "foot0")])
@pytest.mark.parametrize("rate_hz", [5.0, 50.0])
def test_exchanged_labels_are_named_at_every_rate(labels: tuple[str, ...], rate_hz: float) -> None:
    rows = [NAMES.index(name) for name in labels]

    def rotate(t_s: float, points: Array) -> Array:
        if 1.0 < t_s < 5.0:
            points[rows] = points[rows[1:] + rows[:1]]
        return points

    states, notices = track(9.0, rotate, rate_hz)
    assert [(n.data["state"], n.data["markers"]) for n in notices] == [
        ("exchanged", list(labels)), ("ok", list(labels)),
    ]  # fmt: skip
    assert [n.t_ns / 1e9 for n in notices] == pytest.approx([2.2, 7.2], abs=0.4)
    assert states[-1].flags == ()


def test_a_marker_on_the_wrong_segment_is_excluded_and_its_segment_is_named() -> None:
    # shank1 is fixed to the thigh, 3 cm from thigh1
    wrong = replaced("shank1", lambda _, p: 0.5 * (p[4] + p[5]) + (p[6] - p[7]) * 0.2)
    states, notices = track(10.0, wrong)
    assert [n.data.get("moves_with") for n in notices] == [None, "thigh"]
    assert {n.id for n in notices} == {"shank1"}
    assert all(s.flags == ("misplaced:shank1",) for s in states[15:])
    assert np.abs(flexion_errors_deg(states[15:])).max() < 2.0


def test_a_model_of_another_size_is_a_misfit_and_no_marker_is_excluded() -> None:
    states, notices = track(4.0, lambda _, points: 1.5 * points)
    assert [n.data["state"] for n in notices] == ["misfit"]
    assert notices[0].id == "leg"
    assert states[-1].flags[-1] == "misfit"
    assert states[-1].fit is not None
    assert not states[-1].fit.accepted


def test_coordinates_are_unknown_while_markers_do_not_determine_them() -> None:
    def without_foot(_: float, points: Array) -> Array:
        points[13:] = np.nan
        return points

    state = track(0.5, without_foot)[0][-1]
    assert coordinate(state, "foot_rx") == (None, None)
    assert coordinate(state, "shank_angle")[0] is not None
    assert "undetermined" in state.flags

    nothing = track(0.5, lambda _, points: np.full_like(points, np.nan))[0][-1]
    assert nothing.fit is None
    assert all(c.value is None and c.sd is None for c in nothing.coordinates)
    assert all(error is None for error in nothing.errors.values())


def test_a_marker_far_beyond_the_room_counts_as_missing() -> None:
    states, _ = track(3.0, replaced("shank1", lambda t_s, points: points[0] + 1e12 * (t_s > 1.0)))
    assert states[-1].errors["shank1"] is None
    assert np.abs(flexion_errors_deg(states)).max() < 2.0
