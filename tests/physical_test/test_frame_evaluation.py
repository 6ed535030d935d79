"""Three rotations by hand determine world, axes and direction, whatever the heading."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.physical_test._frame_evaluation import explain_frames, fit_frames
from jointfit_daemon.physical_test._rest_finder import MOVED_RAD, REST_S, RestFinder

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

NS = 1_000_000_000
HEADINGS = st.floats(-180.0, 180.0)
HANDS = st.lists(st.floats(-5.0, 5.0), min_size=12, max_size=12)
"""Components of four rotation vectors, deg: the inaccuracies of the four poses."""


def poses(heading_deg: float, hand_deg: list[float]) -> Rotation:
    """Return the orientations, sensor to ENU, before and after each of the three rotations."""
    turns = [
        Rotation.from_euler("z", heading_deg, degrees=True),
        Rotation.from_euler("z", 90, degrees=True),
        Rotation.from_euler("x", 90, degrees=True),
        Rotation.from_euler("z", 90, degrees=True),
    ]
    flat = turns[0]
    turned = turns[1] * flat
    tipped = turned * turns[2]
    last = turns[3] * tipped
    wobble = Rotation.from_rotvec(np.reshape(hand_deg, (4, 3)), degrees=True)
    return Rotation.concatenate([flat, turned, tipped, last]) * wobble


def wxyz(q: Rotation) -> Array:
    return np.asarray(q.as_quat())[:, [3, 0, 1, 2]]


@given(HEADINGS, HANDS)
def test_correct_frames_agree_for_every_heading(heading: float, hand: list[float]) -> None:
    q = wxyz(poses(heading, hand))
    assert fit_frames(q).agrees
    assert explain_frames(q) == (
        "components w x y z, sensor to world, +z of the world points up, sensor axes as printed"
    )


@given(HEADINGS, HANDS, st.floats(-180.0, 180.0))
def test_other_conventions_disagree_and_are_named(
    heading: float, hand: list[float], north: float
) -> None:
    true = poses(heading, hand)
    ned = Rotation.from_euler("zx", [north, 180], degrees=True)
    printed = Rotation.from_euler("y", 90, degrees=True)
    for received, found in (
        (wxyz(true.inv()), "w x y z, world to sensor, +z of the world points up, sensor axes as"),
        (wxyz(ned * true), "sensor to world, -z of the world points up, sensor axes as printed"),
        (wxyz((ned * true).inv()), "world to sensor, -z of the world points up"),
        (wxyz(true * printed), "sensor axes not as printed: x is +z, y is +y, z is -x"),
        (np.asarray(true.as_quat()), "components x y z w, sensor to world, +z of the world"),
    ):
        assert not fit_frames(received).agrees
        assert found in explain_frames(received)


@given(HEADINGS, HANDS)
def test_axes_between_those_printed_are_no_convention(heading: float, hand: list[float]) -> None:
    oblique = Rotation.from_euler("y", 45, degrees=True)
    received = wxyz(poses(heading, hand) * oblique)
    assert not fit_frames(received).agrees
    assert "no convention explains rotations measured as" in explain_frames(received)


def rests_of(angles_deg: Array, rate_hz: float = 100.0) -> list[tuple[int, int]]:
    finder = RestFinder()
    q = wxyz(Rotation.from_rotvec(np.outer(angles_deg, [0.0, 0.0, 1.0]), degrees=True))
    times = (np.arange(len(q)) * NS / rate_hz).astype(int).tolist()
    found = (finder.add(t, tuple(one)) for t, one in zip(times, q.tolist(), strict=True))
    return [rest for rest in found if rest is not None]


@pytest.mark.parametrize("rate_hz", [10.0, 100.0, 400.0])
def test_each_pose_is_one_rest_however_long_it_lasts(rate_hz: float) -> None:
    second = round(rate_hz)
    turn = np.linspace(0.0, 90.0, 2 * second)
    angles = np.concatenate([np.zeros(6 * second), turn, np.full(9 * second, 90.0)])
    first, last = rests_of(angles, rate_hz)
    for begin, end in (first, last):
        assert REST_S * NS <= end - begin <= 1.2 * REST_S * NS
    assert last[0] >= 7.5 * NS


def test_a_moving_sensor_and_a_pause_on_the_way_are_no_rest() -> None:
    assert rests_of(np.linspace(0.0, 360.0, 2000)) == []
    pause = np.degrees(MOVED_RAD) - 5.0
    assert len(rests_of(np.concatenate([np.zeros(200), np.full(300, pause)]))) == 1
