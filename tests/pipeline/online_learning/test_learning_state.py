"""What keeps a limb from learning on: named, timed, told once; nobody in view is no fault."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from jointfit_daemon.model import MocapFrame, MocapLayout
from jointfit_daemon.pipeline.online_learning import Learned, OnlineLearner, models_only
from jointfit_daemon.pipeline.online_learning._learning_state import TOLD_NS, LearningWatch, hidden
from jointfit_daemon.timing.alignment import AlignedFrame
from tests.calibration.calibrated_subject import CHAIN, calibration

MS, S = 1_000_000, 1_000_000_000
SENSORS = ("S1", "S2", "S3")
LAYOUT = MocapLayout(("A", "B", "C", "D"), ())
NOBODY: frozenset[str] = frozenset()


def learner(*, wanted: bool = True, **changed: Any) -> OnlineLearner:
    return OnlineLearner(CHAIN, replace(calibration(), **changed), wanted=wanted)


def wear(
    one: OnlineLearner,
    seconds: float,
    begin_s: float = 0.0,
    *,
    unseen: tuple[int, ...] = (),
    missing: str = "",
    flags: tuple[str, ...] = (),
    layout: MocapLayout = LAYOUT,
) -> list[str]:
    """Sensors and cameras at 20 Hz; return what is told."""
    told = []
    for k in range(round(begin_s * 20), round((begin_s + seconds) * 20)):
        t_ns = k * 50 * MS
        markers = np.full((4, 3), 0.5)
        markers[list(unseen)] = np.nan
        nothing = np.zeros((0, 3)), np.zeros((0, 4))
        one.add_mocap(t_ns, MocapFrame(t_ns, 0, None, layout, markers, *nothing))
        q = math.cos(t_ns / S), math.sin(t_ns / S), 0.0, 0.0
        said = {name: q for name in SENSORS if name != missing}
        one.add_frame(AlignedFrame(t_ns, t_ns, said, NOBODY, NOBODY, True), flags)
        told += [f"{notice.level}: {notice.text}" for notice in one.notices(t_ns)]
    return told


def state(one: OnlineLearner, now_s: float) -> tuple[Any, Any]:
    found = one.health(round(now_s * S))
    return found["state"], found["reason"]


def test_a_marker_that_is_gone_for_good_is_named_and_told_once() -> None:
    one = learner()
    assert wear(one, 10.0) == []
    assert state(one, 10.0) == ("learning", None)
    (told,) = wear(one, 150.0, 10.0, unseen=(1,))
    assert told == "warning: nothing has been learned for 60 s: the cameras do not see B"
    assert state(one, 160.0) == ("stopped", "the cameras do not see B")
    assert one.health(160 * S)["stopped_s"] == pytest.approx(150.0, abs=0.3)
    assert wear(one, 5.0, 160.0) == ["info: learns again from what cameras see"]
    assert one.health(165 * S)["stopped_s"] is None


def test_a_marker_that_was_never_there_is_told_too() -> None:
    assert len(wear(learner(), 70.0, unseen=(0,))) == 1


def test_what_is_hidden_for_a_while_is_no_news() -> None:
    one = learner()
    for k in range(4):
        assert wear(one, 40.0, 50.0 * k, unseen=(2,)) == []
        assert wear(one, 10.0, 50.0 * k + 40.0) == []


def test_nobody_in_view_is_no_fault_and_no_time_counts() -> None:
    one = learner()
    assert wear(one, 100.0, unseen=(0, 1, 2, 3)) == []
    assert state(one, 100.0)[0] == "waiting"
    assert wear(one, 50.0, 100.0, unseen=(0,)) == []


def test_cameras_that_are_off_are_no_fault() -> None:
    one = learner()
    wear(one, 5.0)
    assert one.notices(200 * S) == []
    assert state(one, 200.0) == ("waiting", "no live frame of the cameras")


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"missing": "S2"}, "S2 gives no data"),
        ({"flags": ("slipped:S1",)}, "the sensors are in doubt: slipped:S1"),
        ({"flags": ("heading_disagrees:knee",)}, "in doubt: heading_disagrees:knee"),
        ({"layout": MocapLayout(("A", "B", "C", "X"), ())}, "not in the stream: D"),
    ],
)
def test_every_hindrance_has_its_words(how: dict[str, Any], why: str) -> None:
    one = learner()
    (told,) = wear(one, 70.0, **how)
    assert told.endswith(why)
    assert state(one, 70.0)[0] == "stopped"


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"wanted": False}, "learn_online is off"),
        ({"memory": ""}, "run the functional phase once"),
        ({"clusters": {}}, "no markers are known of thigh"),
    ],
)
def test_what_can_never_learn_says_why_and_tells_nobody(how: dict[str, Any], why: str) -> None:
    one = learner(**how)
    assert wear(one, 70.0) == []
    off, reason = state(one, 70.0)
    assert off == "off"
    assert why in reason


def test_what_was_taken_back_says_so() -> None:
    one = learner()
    wear(one, 5.0)
    found = Learned(paused=True).health(one, 5 * S)
    assert found["state"] == "off"
    assert "unlearn" in str(found["reason"])


def test_many_markers_are_counted_not_listed() -> None:
    assert hidden([f"M{k}" for k in range(9)]).endswith("M0, M1, M2, M3 and 5 more")


def test_a_watch_that_never_looked_tells_nothing() -> None:
    assert LearningWatch().notices(2 * TOLD_NS) == []


def test_what_is_known_of_the_models_is_part_of_them() -> None:
    before = calibration()
    assert models_only(before, replace(before, correlations={"knee": 0.5}))
    assert not models_only(before, replace(before, links=()) if before.links else _other(before))


def _other(before: Any) -> Any:
    return replace(before, flags=("headings_from_static",))
