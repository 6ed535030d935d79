"""Every knob does what it says: measured on what comes out, against what was asked for."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_simulators.body import CLUSTERS, SENSORS, SimulatedSubject, parse_motion_script
from jointfit_simulators.body._random_signal import RandomSignal
from jointfit_simulators.body._soft_tissue import SoftTissue
from jointfit_simulators.devices import NS, CameraFrames, Cameras, OrientationSensor, SampleTiming
from jointfit_simulators.settings import Knobs, apply_settings, perfect
from jointfit_simulators.wires import line_noise

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_simulators.body import Observation

NOTHING = perfect(Knobs())
WALK_AND_SQUATS = parse_motion_script("walk:60,squat:60")
T = np.arange(5.0, 120.0, 0.05)
NONE = np.empty(0)


def rms(lengths: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(lengths))))


def seen(knobs: Knobs, programme: str = "walk:60,squat:60", t: np.ndarray = T) -> list[Rotation]:
    """Return the true orientations of S1..S4 in their bone, mounts included."""
    wearer = SimulatedSubject(knobs, parse_motion_script(programme))
    found = wearer.observe([t] * 4, NONE, t)
    return [
        found.truth.orientations[SENSORS[name]].inv() * Rotation.from_quat(q, scalar_first=True)
        for name, q in zip(SENSORS, found.sensors, strict=True)
    ]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_common_soft_tissue_moves_both_sensors_of_a_segment_alike(seed: int) -> None:
    knobs = dataclasses.replace(NOTHING, soft_tissue_common_deg=5.0, seed=seed)
    s1, s2, s3, s4 = seen(knobs)
    for first, second in ((s1, s2), (s3, s4)):
        assert np.degrees(rms(first.magnitude())) == pytest.approx(5.0, rel=0.12)
        assert (first.inv() * second).magnitude().max() < 1e-9


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_own_soft_tissue_is_each_sensors_own(seed: int) -> None:
    knobs = dataclasses.replace(NOTHING, soft_tissue_sensor_deg=3.0, seed=seed)
    s1, s2, s3, s4 = seen(knobs)
    for first, second in ((s1, s2), (s3, s4)):
        assert np.degrees(rms(first.magnitude())) == pytest.approx(3.0, rel=0.12)
        assert np.degrees(rms((first.inv() * second).magnitude())) > 1.5


@pytest.mark.parametrize("share", [0.0, 0.15, 0.5])
def test_random_share_of_the_artefact_does_not_repeat_with_posture(share: float) -> None:
    wearer = SimulatedSubject(NOTHING, WALK_AND_SQUATS)
    coordinates = wearer._script.coordinates(T)
    skins = [
        SoftTissue(
            np.random.default_rng([7, i]),
            "thigh",
            20,
            rms=0.1,
            random_share=share,
            knee_share=0.65,
            reference=coordinates,
        )
        for i in range(2)
    ]
    for skin in skins:
        here = skin.at(T, coordinates)
        again = skin.at(T + 1e4, coordinates)  # same posture, another time
        half = np.mean(np.sum((here - again) ** 2, axis=-1)) / 2
        assert half / 0.1**2 == pytest.approx(share, rel=0.15, abs=1e-9)


def test_skin_is_still_while_the_wearer_stands() -> None:
    for rotation in seen(
        dataclasses.replace(Knobs(), mount_deg=0.0), "stand", np.arange(0, 30, 0.1)
    ):
        assert np.degrees(rms(rotation.magnitude())) < 0.3


def test_sensors_on_the_plate_do_not_move_relative_to_it() -> None:
    wearer = SimulatedSubject(Knobs(), parse_motion_script("plate"))
    t = np.arange(0.0, 20.0, 0.1)
    found = wearer.observe([t] * 4, t, t)
    plate = found.markers[:, -5:]
    distances = np.linalg.norm(plate[:, :, None] - plate[:, None], axis=-1)
    np.testing.assert_allclose(distances, distances[:1].repeat(len(t), axis=0), atol=1e-12)
    first, *others = (Rotation.from_quat(q, scalar_first=True) for q in found.sensors)
    for other in others:
        apart = first.inv() * other
        assert (apart[0].inv() * apart).magnitude().max() < 1e-9
    turned = np.degrees((first[0].inv() * first).magnitude())
    assert turned.max() > 60


def test_mounts_stay_within_their_bound_and_differ() -> None:
    angles = np.degrees(
        [
            rotation[0].magnitude()
            for seed in range(8)
            for rotation in seen(dataclasses.replace(NOTHING, mount_deg=20.0, seed=seed), t=T[:2])
        ]
    )
    assert angles.max() <= 20.0 + 1e-9
    assert angles.max() > 15
    assert np.std(angles) > 3


def sensor_error(knobs: Knobs, name: str = "S1") -> Rotation:
    t = np.arange(0.0, 2000.0, 0.1)
    sensor = OrientationSensor(knobs, name)
    true = Rotation.random(len(t), rng=2)
    said = sensor.report(t, true.as_quat(scalar_first=True))
    return sensor.world.inv() * Rotation.from_quat(said, scalar_first=True) * true.inv()


@pytest.mark.parametrize("name", ["S1", "S2"])
def test_slow_and_white_errors_have_their_rms(name: str) -> None:
    slow = sensor_error(dataclasses.replace(NOTHING, orientation_slow_deg=1.0), name)
    assert np.degrees(rms(slow.magnitude())) == pytest.approx(1.0, rel=0.1)
    second = np.degrees((slow[:-10].inv() * slow[10:]).magnitude())
    assert rms(second) < 0.5  # slow: it hardly changes within a second
    white = sensor_error(dataclasses.replace(NOTHING, orientation_white_deg=0.3), name)
    assert np.degrees(rms(white.magnitude())) == pytest.approx(0.3, rel=0.05)


def test_headings_spread_up_to_a_right_angle_about_the_vertical() -> None:
    headings = []
    for seed in range(10):
        knobs = dataclasses.replace(NOTHING, heading_spread_deg=90.0, seed=seed)
        for name in SENSORS:
            world = OrientationSensor(knobs, name).world.as_rotvec(degrees=True)
            assert np.abs(world[:2]).max() == 0
            headings.append(world[2])
    assert min(headings) >= 0
    assert max(headings) <= 90
    assert np.ptp(headings) > 75


def test_a_tilted_world_is_a_fault_of_the_chosen_sensor_only() -> None:
    knobs = apply_settings(NOTHING, ["world_tilt_deg=90", "world_tilt_sensor=S2"])
    tilts = {n: OrientationSensor(knobs, n).world.apply([0.0, 0.0, 1.0])[2] for n in SENSORS}
    assert tilts["S2"] == pytest.approx(0, abs=1e-9)
    assert [tilts[n] for n in ("S1", "S3", "S4")] == [1, 1, 1]


def test_clocks_are_offset_and_skewed_within_their_bounds() -> None:
    skews, now = [], 10**13
    for name in "abcdefghijkl":
        ticker = SampleTiming(Knobs(), name, latency_ms=2.0, now_ns=now)
        samples = ticker.samples(now, now + 100 * NS, NS / 100)
        gained = np.polyfit((samples.host_ns - now) / NS, (samples.device_ns - now) / NS, 1)[0] - 1
        assert gained == pytest.approx(ticker.clock.skew, abs=2e-7)
        skews.append(gained * 1e6)
        jitter = samples.device_ns - (samples.host_ns - ticker.clock.boot_ns) * (
            1 + ticker.clock.skew
        )
        assert np.std(jitter) / 1e3 == pytest.approx(20.0, rel=0.1)
        late = (samples.due_ns - samples.host_ns) / 1e6
        assert late.min() >= 2.0
        assert late.mean() - 2.0 == pytest.approx(0.5, rel=0.1)
        assert np.all(np.diff(samples.due_ns) >= 0)
        assert np.mean(samples.dropped) == pytest.approx(0.005, abs=0.003)
    assert max(np.abs(skews)) <= 50
    assert np.ptp(skews) > 40


def test_blocks_share_no_sample_and_miss_none() -> None:
    whole = SampleTiming(Knobs(), "a", latency_ms=0.0, now_ns=10**12)
    blocks = SampleTiming(Knobs(), "a", latency_ms=0.0, now_ns=10**12)
    edges = 10**12 + np.cumsum(np.r_[0, np.random.default_rng(1).integers(1, 10**8, 200)])
    parts = [blocks.samples(a, b, NS / 400).host_ns for a, b in pairwise(edges)]
    once = whole.samples(edges[0], edges[-1], NS / 400).host_ns
    np.testing.assert_array_equal(np.concatenate(parts), once)


@pytest.mark.parametrize("seed", [1, 4])
def test_markers_move_on_the_skin_by_their_rms(seed: int) -> None:
    base = dataclasses.replace(NOTHING, seed=seed)
    knobs = dataclasses.replace(base, marker_soft_tissue_mm=5.0)
    for part in ("thigh", "shank", "foot", "pelvis"):
        moved = np.linalg.norm(marker_errors_against(knobs, base)[part], axis=-1) * 1e3
        assert rms(moved) == pytest.approx(5.0, rel=0.15)
        assert np.sqrt(np.mean(moved**2, axis=0)).min() > 2.5
    errors = marker_errors_against(knobs, base)["thigh"]
    middle = np.linalg.norm(errors.mean(axis=1), axis=-1) * 1e3
    assert rms(middle) == pytest.approx(5.0 * np.sqrt(knobs.marker_common_share), rel=0.15)


def marker_errors_against(knobs: Knobs, base: Knobs) -> dict[str, np.ndarray]:
    t = np.arange(5.0, 120.0, 0.1)
    there = SimulatedSubject(knobs, WALK_AND_SQUATS).observe([NONE] * 4, t, NONE).markers
    still = SimulatedSubject(base, WALK_AND_SQUATS).observe([NONE] * 4, t, NONE).markers
    ends = np.cumsum([len(names) for names in CLUSTERS.values()])
    return dict(zip(CLUSTERS, np.split(there - still, ends[:-1], axis=1), strict=True))


def frames(
    knobs: Knobs, seconds: float = 60.0, programme: str = "walk"
) -> tuple[Cameras, CameraFrames, Observation]:
    wearer = SimulatedSubject(knobs, parse_motion_script(programme))
    cameras = Cameras(knobs, wearer, rate_hz=120.0)
    t = np.arange(0.0, seconds, 1 / 120)
    observation = wearer.observe([NONE] * 4, t, t)
    return cameras, cameras.capture(observation), observation


def test_markers_are_hidden_for_their_share_of_the_time_in_bursts() -> None:
    _, found, _ = frames(apply_settings(NOTHING, ["occlusion=0.05"]), 200.0)
    hidden = np.isnan(found.markers[:, :, 0])
    assert hidden.mean() == pytest.approx(0.05, rel=0.15)
    begins = np.sum(~hidden[:-1] & hidden[1:])
    assert hidden.sum() / begins / 120 == pytest.approx(0.2, rel=0.15)


def test_bodies_come_from_skin_markers_and_vanish_with_them() -> None:
    knobs = apply_settings(NOTHING, ["marker_soft_tissue_mm=5", "occlusion=0.3"])
    cameras, found, observation = frames(knobs, 30.0)
    at = cameras.bodies.index("Thigh")
    columns = [cameras.markers.index(name) for name in CLUSTERS["thigh"]]
    visible = np.isfinite(found.markers[:, columns, 0]).sum(axis=1)
    lost = np.isnan(found.body_orientations[:, at, 0])
    np.testing.assert_array_equal(lost, visible < 3)
    body = Rotation.from_quat(found.body_orientations[~lost, at], scalar_first=True)
    bone = cameras.world * observation.truth.orientations["thigh"][~lost]
    apart = np.degrees((bone.inv() * body).magnitude())
    assert 80 <= np.median(apart) <= 150  # y up at the making, z up in the bone
    relative = bone.inv() * body
    wobble = np.degrees((relative.mean().inv() * relative).magnitude())
    assert 0.3 < rms(wobble) < 6  # the skin's, not the bone's


def test_perfect_bodies_ride_on_their_bones() -> None:
    cameras, found, observation = frames(NOTHING, 10.0, "functional")
    for part in ("pelvis", "thigh", "shank", "foot"):
        at = cameras.bodies.index(part.capitalize())
        body = Rotation.from_quat(found.body_orientations[:, at], scalar_first=True)
        relative = (cameras.world * observation.truth.orientations[part]).inv() * body
        assert (relative[0].inv() * relative).magnitude().max() < 1e-6
    plate = found.body_orientations[:, cameras.bodies.index("Plate")]
    np.testing.assert_allclose(np.abs(plate[0]), [np.sqrt(0.5), np.sqrt(0.5), 0, 0], atol=1e-9)


def test_the_optical_world_is_turned_about_the_vertical() -> None:
    cameras, found, observation = frames(
        apply_settings(NOTHING, ["optical_heading_deg=180"]), 1.0, "stand"
    )
    assert abs(cameras.heading_rad) > 0.05
    np.testing.assert_allclose(found.markers[:, :, 2], observation.markers[:, :, 2], atol=1e-12)
    flat = np.linalg.norm(found.markers[:, :, :2], axis=-1)
    np.testing.assert_allclose(flat, np.linalg.norm(observation.markers[:, :, :2], axis=-1))


def test_line_noise_flips_the_asked_share_of_bytes_and_adds_bursts() -> None:
    data = bytes(1000)
    flips = line_noise(apply_settings(NOTHING, ["line_flip_per_byte=0.01"]), "S1")
    noisy = b"".join(flips(data) for _ in range(100))
    assert len(noisy) == 100_000
    assert np.count_nonzero(np.frombuffer(noisy, np.uint8)) == pytest.approx(1000, rel=0.15)
    bursts = line_noise(
        apply_settings(NOTHING, ["line_burst_per_byte=0.01", "line_burst_bytes=16"]), "S1"
    )
    longer = sum(len(bursts(data)) - 1000 for _ in range(100))
    assert longer == pytest.approx(1000 * 8.5, rel=0.2)
    assert line_noise(NOTHING, "S1")(data) is data


def test_the_same_seed_gives_the_same_run_and_another_seed_another() -> None:
    def run(seed: int) -> np.ndarray:
        knobs = dataclasses.replace(Knobs(), seed=seed)
        wearer = SimulatedSubject(knobs, WALK_AND_SQUATS)
        found = wearer.observe([T] * 4, T, T)
        said = [
            OrientationSensor(knobs, name).report(T, q)
            for name, q in zip(SENSORS, found.sensors, strict=True)
        ]
        markers = Cameras(knobs, wearer, rate_hz=120.0).capture(found).markers
        return np.concatenate([*map(np.ravel, said), np.ravel(markers)])

    np.testing.assert_array_equal(run(3), run(3))
    assert not np.allclose(run(3), run(4), equal_nan=True)


def test_turning_one_knob_leaves_the_other_dice_as_they_fell() -> None:
    one, other = (seen(apply_settings(NOTHING, [f"mount_deg={d}"]), t=T[:5]) for d in (10, 20))
    for small, large in zip(one, other, strict=True):
        np.testing.assert_allclose(2 * small.as_rotvec(), large.as_rotvec(), atol=1e-9)


def test_wanders_can_be_read_in_any_order_and_stay_in_their_band() -> None:
    wander = RandomSignal(np.random.default_rng(1), 2, low_hz=0.5, high_hz=2.0, rms=3.0)
    t = np.arange(0, 400, 0.05)
    found = wander.at(t)
    np.testing.assert_allclose(wander.at(t[::-1])[::-1], found, atol=1e-9)
    assert np.sqrt(np.mean(found**2, axis=0)) == pytest.approx([3.0, 3.0], rel=0.05)
    power = np.abs(np.fft.rfft(found[:, 0])) ** 2
    hertz = np.fft.rfftfreq(len(t), 0.05)
    inside = (hertz > 0.45) & (hertz < 2.05)
    assert power[inside].sum() / power.sum() > 0.98


def test_an_unknown_knob_is_answered_with_the_nearest_one() -> None:
    with pytest.raises(ValueError, match="did you mean 'dropout'"):
        apply_settings(Knobs(), ["dropot=1"])
    with pytest.raises(ValueError, match="expected float"):
        apply_settings(Knobs(), ["dropout=much"])
