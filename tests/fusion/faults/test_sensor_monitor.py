"""Lost and stuck sensors are detected in time and reported once; healthy sensors are not."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.fusion import SensorMonitor
from jointfit_daemon.fusion.faults._stuck import StuckSensorDetector
from jointfit_daemon.model import Chain

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.model import Quaternion

    Frames = list[dict[str, Quaternion]]

MS = 1_000_000
STEP = 10 * MS
GROUPS = (("S1", "S2"), ("S3", "S4"))
CHAIN = Chain(("hip", "knee", "ankle"), ("thigh", "shank"), GROUPS)


def limb(seconds: float, *, speed: float = 1.0, noise_deg: float = 0.05, seed: int = 1) -> Frames:
    """Return orientations of four sensors of a swinging limb, each with a random alignment."""
    rng = np.random.default_rng(seed)
    t = np.arange(round(100 * seconds)) / 100
    swing = {"thigh": 0.5 * np.sin(2 * np.pi * speed * t), "shank": np.sin(2 * np.pi * speed * t)}
    columns = {}
    for segment, group in zip(CHAIN.segments, GROUPS, strict=True):
        bone = Rotation.from_rotvec(np.outer(swing[segment], [1.0, 0.1, 0.0]))
        for name in group:
            scatter = Rotation.from_rotvec(np.radians(noise_deg) * rng.normal(size=(len(t), 3)))
            q = bone * scatter * Rotation.random(random_state=rng)
            columns[name] = [tuple(row) for row in q.as_quat(scalar_first=True).tolist()]
    return [{name: rows[k] for name, rows in columns.items()} for k in range(len(t))]


def detection_time_ms(frames: Frames, inject: Callable[[Frames], Frames], name: str) -> float:
    """Return the time of detection, ms since frame 0; check that no other sensor is detected."""
    monitor, found = StuckSensorDetector(GROUPS), np.inf
    for k, orientations in enumerate(inject(frames)):
        stuck = monitor.update(k * STEP, orientations)
        assert set(stuck) <= {name}
        if stuck and not np.isfinite(found):
            found = 10.0 * k
    return found


@pytest.mark.parametrize("behind", [1, 2, 3])
def test_sensors_that_leave_a_noiseless_rest_some_frames_apart_are_not_stuck(behind: int) -> None:
    # The samples of the other sensors are delayed, so these sensors seem to rest for longer.
    there = limb(6.0, noise_deg=0.0, speed=0.4)
    frames = there + [there[-1]] * 100 + there[::-1][:50]
    detector = StuckSensorDetector(GROUPS)
    for k, orientations in enumerate(frames):
        held = frames[k - behind] if k > behind else frames[0]
        seen = held | {"S2": orientations["S2"]}
        assert not detector.update(k * STEP, seen), k


def hold_value(name: str, first: int) -> Callable[[Frames], Frames]:
    def inject(frames: Frames) -> Frames:
        return [f | {name: frames[min(k, first)][name]} for k, f in enumerate(frames)]

    return inject


@pytest.mark.parametrize("first", [600, 613, 625, 650, 671])
@pytest.mark.parametrize("name", ["S1", "S4"])
def test_sensor_repeating_itself_while_its_partner_moves_is_stuck(name: str, first: int) -> None:
    assert detection_time_ms(limb(8.0), hold_value(name, first), name) <= 10 * first + 250


@pytest.mark.parametrize("name", ["S2", "S3"])
def test_sensor_that_sticks_at_rest_is_detected_at_rest(name: str) -> None:
    still = limb(9.0, speed=0.0, noise_deg=0.01)
    assert detection_time_ms(still, hold_value(name, 700), name) <= 7000 + 500


def test_sensor_with_noise_about_a_fixed_orientation_is_stuck() -> None:
    frames, rng = limb(8.0), np.random.default_rng(3)

    def inject(frames: Frames) -> Frames:
        out = []
        for k, orientations in enumerate(frames):
            w, x, y, z = frames[min(k, 630)]["S3"]
            dx, dy = 0.0003 * rng.normal(size=2) * (k > 630)
            out.append(orientations | {"S3": (w, x + dx, y + dy, z)})
        return out

    assert detection_time_ms(frames, inject, "S3") <= 6300 + 500


@pytest.mark.parametrize("digits", [3, 4])
@pytest.mark.parametrize("speed", [0.0, 0.05, 1.0])
def test_coarse_resolution_and_slow_filters_are_not_stuck(digits: int, speed: float) -> None:
    """S2 rounds to 3 or 4 digits and changes every third frame; the limb rests or moves."""
    frames = limb(20.0, speed=speed, noise_deg=0.02)
    for k, orientations in enumerate(frames):
        w, x, y, z = (round(value, digits) for value in frames[k - k % 3]["S2"])
        orientations["S2"] = (w, x, y, z)
    monitor = StuckSensorDetector(GROUPS)
    stuck = sum(
        bool(monitor.update(k * STEP, orientations)) for k, orientations in enumerate(frames)
    )
    # The detector learns how long the values of a sensor normally repeat. Before that, it may
    # report a slow sensor with three digits.
    assert stuck <= (50 if digits == 3 and speed < 1 else 0)


def test_only_sensor_of_a_segment_is_compared_with_the_other_segment() -> None:
    frames = [{k: q for k, q in orientations.items() if k != "S2"} for orientations in limb(8.0)]
    assert detection_time_ms(frames, hold_value("S1", 640), "S1") <= 6400 + 500


def test_both_sensors_of_a_segment_stuck_at_once_are_detected() -> None:
    frames = hold_value("S2", 640)(hold_value("S1", 640)(limb(8.0)))
    monitor = StuckSensorDetector(GROUPS)
    stuck = [set(monitor.update(k * STEP, orientations)) for k, orientations in enumerate(frames)]
    assert set().union(*stuck[:641]) == set()
    assert all(found == {"S1", "S2"} for found in stuck[690:])


def test_stuck_sensor_is_used_again_after_200_ms_of_movement() -> None:
    frames = limb(9.0)
    monitor = StuckSensorDetector(GROUPS)
    again = [
        f | ({"S1": frames[600]["S1"]} if 600 <= k < 700 else {}) for k, f in enumerate(frames)
    ]
    stuck = [bool(monitor.update(k * STEP, orientations)) for k, orientations in enumerate(again)]
    assert all(stuck[630:700])
    assert not any(stuck[722:])


# --- reports -------------------------------------------------------------------------------


def reports(frames: Frames) -> list[tuple[int, str, str]]:
    """Return time (ms), id and state of all reports over the frames."""
    monitor, out = SensorMonitor(CHAIN), []
    for k, orientations in enumerate(frames):
        monitor.update(k * STEP, k * STEP, orientations)
        out += [(10 * k, report.id, report.state) for report in monitor.pop_reports(k * STEP)]
    return out


def remove_samples(name: str, first: int, end: int, frames: Frames) -> Frames:
    return [
        {n: q for n, q in orientations.items() if n != name or not first <= k < end}
        for k, orientations in enumerate(frames)
    ]


def test_healthy_sensors_and_short_gaps_give_no_report() -> None:
    assert reports(limb(10.0)) == []
    assert reports(remove_samples("S1", 300, 315, limb(5.0))) == []


def test_loss_and_recovery_are_reported_once_each_in_time() -> None:
    lost, back = reports(remove_samples("S1", 300, 400, limb(8.0)))
    assert lost[1:] == ("S1", "lost")
    assert 3000 <= lost[0] <= 3500
    assert back[1:] == ("S1", "ok")
    assert 6000 <= back[0] <= 6500


def test_loose_connector_is_reported_as_one_loss() -> None:
    frames = limb(20.0)
    for first in range(300, 1500, 100):
        frames = remove_samples("S3", first, first + 50, frames)
    assert [state for _, _, state in reports(frames)] == ["lost", "ok"]


def test_silence_of_all_sensors_is_reported() -> None:
    frames = limb(8.0)
    frames[300:400] = [{}] * 100
    report = reports(frames)
    assert {(name, state) for _, name, state in report[:4]} == {
        (s, "lost") for g in GROUPS for s in g
    }
    assert {t for t, _, _ in report[:4]} == {3200}


def test_report_names_the_remaining_sensors() -> None:
    monitor = SensorMonitor(CHAIN)
    for k, orientations in enumerate(remove_samples("S1", 100, 200, limb(2.0))):
        monitor.update(k * STEP, k * STEP, orientations)
        for report in monitor.pop_reports(k * STEP):
            assert report.text == "no data; thigh uses S2"
            assert report.level == "warning"
    assert monitor.state("S1") == "lost"
    assert monitor.state("S2") == "ok"
