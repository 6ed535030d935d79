"""Faulty marker labels are reported and hidden from fusion until they are correct again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline._label_monitor import LabelMonitor
from jointfit_daemon.pipeline.events import Notice, NoticeKind, NoticeLevel
from tests.calibration.synthetic_limb import CHAIN
from tests.limb_model.clusters_of_limb import LABELS, calibration_of, cycled, person
from tests.limb_model.test_label_search import EXCHANGES

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

Change = Callable[[float, "Array"], "Array"]
LAYOUT = MocapLayout(LABELS, ())


def camera_frame(number: int, points: Array) -> MocapFrame:
    return MocapFrame(0, number, None, LAYOUT, points, np.zeros((0, 3)), np.zeros((0, 4)))


def displaced(points: Array, label: str, by: tuple[float, float, float]) -> Array:
    points = points.copy()
    points[LABELS.index(label)] += by
    return points


def watch(
    change: Change, *, seed: int = 2, skin_m: float = 0.004, occluded: float = 0.0
) -> tuple[LabelMonitor, list[Notice]]:
    """Return the monitor after 10 s of movement, and its notices."""
    clusters, stamps, positions = person(seed, skin_m, occluded)
    monitor = LabelMonitor(CHAIN, calibration_of(clusters))
    notices: list[Notice] = []
    for k, (t_ns, points) in enumerate(zip(stamps.tolist(), positions, strict=True)):
        outputs = monitor.add_frame(t_ns, camera_frame(k, change(t_ns / 1e9, points)))
        notices += [one for one in outputs if isinstance(one, Notice)]
    assert len(notices) == sum(one.kind is NoticeKind.MARKER for one in notices)
    return monitor, notices


def between(start_s: float, end_s: float, change: Callable[[Array], Array]) -> Change:
    return lambda t_s, points: change(points) if start_s <= t_s < end_s else points


@pytest.mark.parametrize("labels", EXCHANGES, ids="-".join)
def test_an_exchange_is_reported_after_two_seconds_and_its_end_too(labels: tuple[str, ...]) -> None:
    exchange = between(1.0, 6.0, lambda points: cycled(points, *labels))
    _, notices = watch(exchange, skin_m=0.006, occluded=0.02)
    assert [one.data["state"] for one in notices] == ["exchanged", "ok"]
    begin, end = notices
    assert (begin.level, end.level) == (NoticeLevel.WARNING, NoticeLevel.INFO)
    assert begin.data["markers"] == list(labels) == end.data["markers"]
    assert begin.data["segments"] == sorted({name[:-1] for name in labels})
    for name, other in zip(labels, labels[1:] + labels[:1], strict=True):
        assert f"{name} is at the place of {other}" in begin.text
    assert "Correct the labels" in begin.text
    assert 2.0 < begin.t_ns / 1e9 < 3.5
    assert 7.5 < end.t_ns / 1e9 < 8.5


def test_faulty_markers_are_hidden_and_the_others_are_not() -> None:
    monitor, _ = watch(lambda _, points: cycled(points, "thigh0", "shank1"))
    frame = camera_frame(0, person(2)[2][0])
    hidden = np.isnan(monitor.hide_faulty(frame).markers[:, 0]).tolist()
    assert [name for name, here in zip(LABELS, hidden, strict=True) if here] == ["thigh0", "shank1"]
    assert np.isfinite(frame.markers).all()
    monitor.reset()
    assert monitor.hide_faulty(frame) is frame


def test_an_exchange_of_less_than_two_seconds_is_not_reported() -> None:
    flicker = between(3.0, 4.0, lambda points: cycled(points, "thigh0", "thigh2"))
    assert watch(flicker)[1] == []


def test_another_exchange_takes_the_place_of_the_first() -> None:
    def twice(t_s: float, points: Array) -> Array:
        pair = ("thigh0", "thigh2") if t_s < 5.0 else ("thigh0", "thigh1")
        return cycled(points, *pair)

    monitor, notices = watch(twice)
    assert [one.data["markers"] for one in notices] == [["thigh0", "thigh2"], ["thigh0", "thigh1"]]
    assert [fault.markers for fault in monitor.faults] == [("thigh0", "thigh1")]


def test_a_label_on_a_marker_of_another_segment_is_named_with_its_place() -> None:
    thigh, shank = LABELS.index("thigh1"), LABELS.index("shank2")

    def mislabel(points: Array) -> Array:
        points = points.copy()
        points[shank], points[thigh] = points[thigh], np.nan
        return points

    _, (notice,) = watch(lambda _, points: mislabel(points))
    assert "shank2 is at the place of thigh1, which is hidden" in notice.text
    assert notice.data == {
        "state": "exchanged", "markers": ["shank2", "thigh1"], "segments": ["shank", "thigh"]
    }  # fmt: skip


def test_a_displaced_marker_is_named_and_the_others_give_the_pose() -> None:
    monitor, (notice,) = watch(lambda _, points: displaced(points, "shank3", (0.09, 0.06, 0.05)))
    assert notice.data["state"] == "misplaced"
    assert notice.text.startswith("shank3: not at its place on shank")
    assert [fault.markers for fault in monitor.faults] == [("shank3",)]


def test_a_cluster_that_nothing_explains_is_reported_with_its_residual() -> None:
    rows = [LABELS.index(f"thigh{k}") for k in range(4)]
    places = np.random.default_rng(1).normal(0.0, 0.1, (4, 3))

    def replaced(points: Array) -> Array:
        points = points.copy()
        points[rows] = points[rows].mean(axis=0) + places
        return points

    _, notices = watch(between(0.0, 7.0, replaced))
    assert [(one.id, one.data["state"]) for one in notices] == [
        ("thigh", "misfit"),
        ("thigh", "ok"),
    ]
    assert "mm RMS, at most 30 mm expected" in notices[0].text
    assert 0.03 < float(str(notices[0].data["rms_m"])) < 0.3


def test_hidden_markers_neither_begin_nor_end_a_fault() -> None:
    exchanged = between(0.0, 4.0, lambda points: cycled(points, "thigh0", "thigh2"))
    rows = [LABELS.index(f"thigh{k}") for k in range(4)]

    def then_hidden(t_s: float, points: Array) -> Array:
        points = exchanged(t_s, points).copy()
        if t_s > 4.0:
            points[rows] = np.nan
        return points

    monitor, notices = watch(then_hidden)
    assert [one.data["state"] for one in notices] == ["exchanged"]
    assert monitor.faults


@pytest.mark.parametrize("seed", range(10, 16))
def test_healthy_people_have_no_notice(seed: int) -> None:
    assert watch(lambda _, points: points, seed=seed, skin_m=0.01, occluded=0.08)[1] == []


def test_rigid_bodies_are_not_monitored() -> None:
    clusters, stamps, positions = person(2)
    calibration = calibration_of(clusters)
    body = replace(calibration.clusters["thigh"], body="Thigh", markers=())
    changed = replace(calibration, clusters={**calibration.clusters, "thigh": body})
    monitor = LabelMonitor(CHAIN, changed)
    mixed = cycled(positions, "thigh0", "shank2")
    for t_ns, points in zip(stamps.tolist(), mixed, strict=True):
        monitor.add_frame(t_ns, camera_frame(0, points))
    # the marker of the thigh belongs to no cluster, so its place is unknown
    assert [fault.markers for fault in monitor.faults] == [("shank2",)]
    without = replace(calibration, clusters={})
    assert LabelMonitor(CHAIN, without).add_frame(0, camera_frame(0, positions[0])) == []


def test_a_monitor_serves_a_calibration_with_equal_clusters_and_centers_only() -> None:
    calibration = calibration_of(person(2)[0])
    monitor = LabelMonitor(CHAIN, calibration)
    assert monitor.serves(CHAIN, replace(calibration, notes=("refit",)))
    fewer = {name: one for name, one in calibration.clusters.items() if name != "foot"}
    assert not monitor.serves(CHAIN, replace(calibration, clusters=fewer))
    assert not monitor.serves(CHAIN, replace(calibration, joint={}))
