"""Planar tracker: a chain with one marker on each end segment and two on each inner segment."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.center_of_rotation.planar import plane_of
from jointfit_daemon.model import Chain, MocapFrame, MocapLayout, StickFigure
from jointfit_daemon.pipeline.planar_chain import PlanarTracker

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.pipeline.events import Notice

RATE_HZ = 50
CHAIN = Chain(
    ("hip", "knee", "ankle"), ("thigh", "shank"), ((), ()),
    proximal="pelvis", distal="foot", planar=True,
)  # fmt: skip
MARKERS = {"pelvis": ("P1",), "thigh": ("T1", "T4"), "shank": ("C1", "C4"), "foot": ("F1",)}
NAMES = ("P1", "T1", "T4", "C1", "C4", "F1")
LOCAL = {  # m; forward and up in the plane, from the proximal joint of the segment
    "P1": (-0.08, 0.12), "T1": (0.06, -0.12), "T4": (-0.05, -0.31), "C1": (0.05, -0.08),
    "C4": (-0.04, -0.29), "F1": (0.13, -0.05),
}  # fmt: skip
THIGH_M, SHANK_M = 0.43, 0.41
NOISE_M = 0.0005
WORLD = Rotation.from_euler("z", 35.0, degrees=True)
"""The plane is vertical, 35 degrees from the axes of the cameras."""
NORMAL = WORLD.apply((1.0, 0.0, 0.0))
SIDE_M = {"P1": 0.1, "T1": 0.12, "T4": 0.08, "C1": 0.1, "C4": 0.06, "F1": 0.05}
"""Distance of each marker from the plane of the joints, m."""


def spin(angle: float, point: tuple[float, float]) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])


def flat(t_s: float) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return joints and markers in the plane, m: forward, up."""
    hip_turn = 0.3 + 0.7 * np.sin(2.1 * t_s)
    knee_turn = hip_turn - (0.8 + 0.7 * np.sin(2.9 * t_s))
    foot_turn = knee_turn + 0.5 * np.sin(4.3 * t_s)
    hip = np.array([0.05 * np.sin(0.7 * t_s), 0.9 + 0.02 * np.sin(1.3 * t_s)])
    knee = hip + spin(hip_turn, (0.0, -THIGH_M))
    ankle = knee + spin(knee_turn, (0.0, -SHANK_M))
    own = {
        "P": (hip, 0.05 * np.sin(0.9 * t_s)), "T": (hip, hip_turn), "C": (knee, knee_turn),
        "F": (ankle, foot_turn),
    }  # fmt: skip
    placed = {name: own[name[0]][0] + spin(own[name[0]][1], LOCAL[name]) for name in NAMES}
    return {"hip": hip, "knee": knee, "ankle": ankle}, placed


def in_space(point: Array, side: float) -> Array:
    return np.asarray(WORLD.apply((side, point[0], point[1])))


def track(
    seconds: float,
    change: Callable[[float, Array], Array] = lambda _, points: points,
    *,
    off_plane: float = 0.0,
    memory_s: float = 60.0,
    shown_hz: float = 25.0,
) -> tuple[list[StickFigure], list[Notice]]:
    tracker = PlanarTracker(CHAIN, MARKERS, shown_hz, memory_s)
    rng = np.random.default_rng(4)
    layout = MocapLayout(NAMES, ())
    figures: list[StickFigure] = []
    notices: list[Notice] = []
    for k in range(round(seconds * RATE_HZ)):
        t_s = k / RATE_HZ
        _, placed = flat(t_s)
        sway = off_plane * np.sin(5.0 * t_s)
        points = np.array([in_space(placed[name], SIDE_M[name] + sway) for name in NAMES])
        points = change(t_s, points + rng.normal(0.0, NOISE_M, points.shape))
        frame = MocapFrame(0, k, None, layout, points, np.zeros((0, 3)), np.zeros((0, 4)))
        for output in tracker.add_frame(round(t_s * 1e9), frame):
            (figures if isinstance(output, StickFigure) else notices).append(output)  # type: ignore[arg-type]  # one of the two
    return figures, notices


def errors_m(figure: StickFigure, name: str) -> float:
    """Return the distance of a joint from its true position within the plane, m."""
    joint = next(joint for joint in figure.joints if joint.name == name)
    assert joint.position is not None, joint.refused
    true = in_space(flat(figure.t_ns / 1e9)[0][name], 0.0)
    away = np.array(joint.position) - true
    return float(np.linalg.norm(away - NORMAL * (away @ NORMAL)))


def hide(name: str, from_s: float, to_s: float) -> Callable[[float, Array], Array]:
    def change(t_s: float, points: Array) -> Array:
        if from_s <= t_s < to_s:
            points[NAMES.index(name)] = np.nan
        return points

    return change


def test_joints_are_found_within_their_predicted_errors() -> None:
    figures, notices = track(15.0)
    assert [n.text for n in notices] == ["plane of movement found"]
    last = [f for f in figures if f.t_ns > 10e9]
    assert len(figures) == pytest.approx(15 * 25, abs=2)
    assert last[-1].normal is not None
    assert abs(np.array(last[-1].normal) @ NORMAL) > np.cos(np.radians(1.0))
    assert last[-1].off_plane is not None
    assert last[-1].off_plane < 0.002
    for name in ("hip", "knee", "ankle"):
        off = np.array([errors_m(figure, name) for figure in last])
        predicted = np.array([j.error for f in last for j in f.joints if j.name == name])
        assert np.sqrt(np.mean(off**2)) < 0.004
        assert 0.3 < np.sqrt(np.mean((off / predicted) ** 2)) < 1.8


def test_stick_figure_joins_markers_at_the_ends_and_joints_between() -> None:
    figure = track(8.0)[0][-1]
    assert [stick.segment for stick in figure.sticks] == ["pelvis", "thigh", "shank", "foot"]
    ends = {stick.segment: stick.ends for stick in figure.sticks}
    positions = {joint.name: joint.position for joint in figure.joints}
    assert ends["thigh"] == (positions["hip"], positions["knee"])
    assert ends["shank"] == (positions["knee"], positions["ankle"])
    assert ends["pelvis"][1] == positions["hip"]
    assert ends["foot"][0] == positions["ankle"]
    marker = in_space(flat(figure.t_ns / 1e9)[1]["F1"], SIDE_M["F1"])
    assert ends["foot"][1] == pytest.approx(tuple(marker), abs=0.003)


def test_joint_of_one_side_is_unknown_while_a_marker_is_missing() -> None:
    figures, _ = track(14.0, hide("T4", 10.0, 12.0))
    during = [f for f in figures if 10.1e9 < f.t_ns < 11.9e9]
    for figure in during:
        hip, knee, ankle = figure.joints
        assert hip.position is None  # the pelvis has one marker
        assert hip.refused == "thigh: T4 not visible"
        assert knee.position is not None  # estimated from the shank alone
        assert errors_m(figure, "knee") < 0.006
        assert ankle.position is not None
        assert figure.sticks[1].ends[0] is None
    assert figures[-1].joints[0].position is not None
    assert errors_m(figures[-1], "hip") < 0.004


def test_end_marker_is_needed_for_its_end_of_the_stick_only() -> None:
    figures, _ = track(11.0, hide("F1", 10.0, 11.0))
    assert errors_m(figures[-1], "ankle") < 0.004  # from the shank and the earlier center
    assert figures[-1].sticks[3].ends[1] is None


def test_exchanged_labels_are_reported_until_they_are_correct() -> None:
    def exchange(t_s: float, points: Array) -> Array:
        return points[[0, 2, 1, 3, 4, 5]] if 10.0 <= t_s < 12.0 else points

    figures, _ = track(14.0, exchange)
    during = [f for f in figures if 10.1e9 < f.t_ns < 11.9e9]
    assert {f.joints[0].refused for f in during} == {
        "thigh: T1 and T4 look exchanged: correct their labels"
    }
    assert errors_m(figures[-1], "hip") < 0.004
    assert all(errors_m(f, "knee") < 0.006 for f in during)


def test_marker_of_another_segment_gives_no_center() -> None:
    def swap(_: float, points: Array) -> Array:
        return points[[0, 1, 4, 3, 2, 5]]  # T4 and C4 are on each other's segment

    figures, _ = track(10.0, swap)
    assert all(joint.position is None for joint in figures[-1].joints)
    assert "do not move together" in str(figures[-1].joints[1].refused)


def test_small_and_spatial_movements_have_no_plane() -> None:
    first: list[Array] = []

    def still(_: float, points: Array) -> Array:
        first.append(points)
        return first[0]

    figures, notices = track(5.0, still)
    assert notices == []
    assert figures[-1].normal is None
    assert "move the joints further" in str(figures[-1].refused)
    assert figures[-1].joints[0].refused == figures[-1].refused

    figures, _ = track(5.0, off_plane=0.3)
    assert "the movement is not planar" in str(figures[-1].refused)


def test_change_of_the_plane_begins_the_centers_again() -> None:
    turn = Rotation.from_euler("z", 40.0, degrees=True)

    def turned(t_s: float, points: Array) -> Array:
        return turn.apply(points) if t_s >= 8.0 else points

    figures, notices = track(40.0, turned, memory_s=5.0, shown_hz=1.0)
    assert [n.text for n in notices][:2] == [
        "plane of movement found",
        "plane of movement changed: the joint centres are estimated again",
    ]
    assert figures[-1].normal is not None
    assert abs(np.array(figures[-1].normal) @ turn.apply(NORMAL)) > np.cos(np.radians(2.0))
    knee = figures[-1].joints[1].position
    assert knee is not None
    true = turn.apply(in_space(flat(figures[-1].t_ns / 1e9)[0]["knee"], 0.0))
    across = (np.array(knee) - true) @ plane_of(turn.apply(NORMAL))
    assert np.linalg.norm(across) < 0.01


def exchange_and_hide(
    exchanged_s: tuple[float, float], *hidden_s: tuple[float, float]
) -> Callable[[float, Array], Array]:
    """Exchange T1 and T4 in one interval, and hide T1 in other intervals."""

    def change(t_s: float, points: Array) -> Array:
        if exchanged_s[0] <= t_s < exchanged_s[1]:
            points = points[[0, 2, 1, 3, 4, 5]]
        for from_s, to_s in hidden_s:
            points = hide("T1", from_s, to_s)(t_s, points)
        return points

    return change


EXCHANGED = "thigh: T1 and T4 look exchanged: correct their labels"


def assert_small_errors(figures: list[StickFigure]) -> None:
    for figure in figures:
        for joint in figure.joints:
            assert joint.position is None or errors_m(figure, joint.name) < 0.008


@pytest.mark.parametrize(
    ("exchanged_s", "hidden_s"),
    [
        ((10.0, 15.0), [(12.0, 12.5), (17.0, 17.5)]),  # exchanged before and after an occlusion
        ((10.0, 12.2), [(12.0, 12.5)]),  # corrected while a marker is hidden
        ((10.2, 15.0), [(10.0, 10.5)]),  # exchanged while a marker is hidden
        ((10.2, 10.4), [(10.0, 10.5), (11.0, 14.0)]),  # exchanged and corrected while hidden
        ((10.0, 15.0), [(9.5, 10.3), (14.9, 18.0)]),
    ],
)
def test_exchanged_labels_give_no_wrong_joint_across_occlusions(
    exchanged_s: tuple[float, float], hidden_s: list[tuple[float, float]]
) -> None:
    figures, _ = track(20.0, exchange_and_hide(exchanged_s, *hidden_s))
    assert_small_errors([f for f in figures if f.t_ns > 9e9])

    end_ns = round(1e9 * max(exchanged_s[1], *(to_s for _, to_s in hidden_s)))
    for figure in figures:
        visible = not any(a - 0.1 < figure.t_ns / 1e9 < b + 0.1 for a, b in hidden_s)
        if exchanged_s[0] + 0.1 < figure.t_ns / 1e9 < exchanged_s[1] - 0.1 and visible:
            assert figure.joints[0].refused == EXCHANGED
        elif figure.t_ns > max(9e9, end_ns + 0.1e9):
            assert all(joint.position is not None for joint in figure.joints)
            assert errors_m(figure, "hip") < 0.004


def test_two_segments_with_exchanged_labels_give_no_wrong_joint_after_an_occlusion() -> None:
    def change(t_s: float, points: Array) -> Array:
        if 10.0 <= t_s < 12.6:
            points = points[[0, 2, 1, 4, 3, 5]]
        if 11.0 <= t_s < 11.5 or 12.5 <= t_s < 12.9:
            points[:] = np.nan
        if 11.5 <= t_s < 12.0:
            points[[0, 5]] = np.nan  # only thigh and shank are visible
        return points

    figures, notices = track(18.0, change)
    assert_small_errors([f for f in figures if f.t_ns > 9e9])
    assert all(j.position is not None for f in figures if f.t_ns > 13.1e9 for j in f.joints)
    assert [n.data["state"] for n in notices[1:]] == ["exchanged", "exchanged", "ok", "ok"]


def test_pose_after_an_occlusion_waits_for_the_adjacent_markers() -> None:
    def change(t_s: float, points: Array) -> Array:
        if 10.0 <= t_s < 10.5:
            points[:] = np.nan
        if 10.5 <= t_s < 12.0:
            points[[0, 3, 4, 5]] = np.nan  # only the thigh is visible
        return points

    figures, _ = track(14.0, change)
    during = [f for f in figures if 10.6e9 < f.t_ns < 11.9e9]
    assert {f.joints[0].refused for f in during} == {
        "thigh: T1 and T4 were hidden and may have been exchanged: show the markers of the "
        "adjacent segments"
    }
    after = [f for f in figures if f.t_ns > 12.1e9]
    assert all(errors_m(f, name) < 0.004 for f in after for name in ("hip", "knee", "ankle"))


def test_labels_that_remain_exchanged_are_used_after_a_minute() -> None:
    def change(t_s: float, points: Array) -> Array:
        return points[[0, 2, 1, 3, 4, 5]] if t_s < 8.0 else points  # wrong at the start

    figures, notices = track(80.0, change, shown_hz=2.0)
    assert_small_errors([f for f in figures if f.t_ns > 9e9])
    assert [(n.id, n.data["state"]) for n in notices[1:]] == [("T1", "exchanged"), ("T1", "ok")]
    assert notices[2].text == (
        "T1 and T4: the joint centres are estimated again with the present labels. "
        "Move the joints of thigh"
    )
    assert errors_m(figures[-1], "hip") < 0.004


def test_occlusions_of_correct_labels_restart_nothing() -> None:
    rng = np.random.default_rng(7)
    starts = {name: np.sort(rng.uniform(0.0, 40.0, 25)) for name in NAMES}

    def change(t_s: float, points: Array) -> Array:
        for k, name in enumerate(NAMES):
            if ((starts[name] <= t_s) & (t_s < starts[name] + 0.35)).any():
                points[k] = np.nan
        return points

    figures, notices = track(40.0, change)
    assert [n.text for n in notices] == ["plane of movement found"]
    late = [f for f in figures if f.t_ns > 10e9]
    assert_small_errors(late)
    assert not any("exchanged:" in str(j.refused) for f in late for j in f.joints)
    without = [
        f for f in late if any("may have been exchanged" in str(j.refused) for j in f.joints)
    ]
    assert len(without) < 0.02 * len(late)


def test_lost_and_exchanged_markers_are_reported() -> None:
    _, notices = track(36.0, hide("T4", 6.0, 20.0), shown_hz=5.0)
    assert [(n.id, n.level, n.text) for n in notices[1:]] == [
        ("T4", "warning", "T4: not visible for 10 s; joints that need it have no position. "
         "Uncover it, fix it, or correct its name"),
        ("T4", "info", "T4: visible again after 14 s"),
    ]  # fmt: skip
    assert notices[1].data["state"] == "lost"

    _, notices = track(24.0, exchange_and_hide((10.0, 15.0), (12.0, 12.5)), shown_hz=5.0)
    data = {"markers": ["T1", "T4"], "segments": ["thigh"]}
    assert [(n.id, n.text, n.data) for n in notices[1:]] == [
        ("T1", "T1 and T4 on thigh look exchanged. Correct their labels; these markers are not "
         "used until then. After 60 s, the present labels are used",
         {"state": "exchanged", **data}),
        ("T1", "T1 and T4: at the expected place again, and in use", {"state": "ok", **data}),
    ]  # fmt: skip
    assert 11.0e9 <= notices[1].t_ns < 11.2e9
    assert 17.0e9 <= notices[2].t_ns < 17.2e9


def test_marker_on_another_segment_is_reported() -> None:
    def swap(t_s: float, points: Array) -> Array:
        return points[[0, 1, 4, 3, 2, 5]] if 8.0 <= t_s < 20.0 else points

    _, notices = track(30.0, swap, shown_hz=5.0)
    found = {(n.id, n.data["state"]) for n in notices[1:]}
    assert found == {(part, state) for part in ("thigh", "shank") for state in ("misfit", "ok")}
