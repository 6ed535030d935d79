"""Error magnitudes of the simulated measurements, compared with the settings."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.body import CLUSTERS, SENSORS, SimulatedSubject, parse_motion_script
from jointfit_simulators.body._random_signal import RandomSignal
from jointfit_simulators.body._soft_tissue import SoftTissue
from jointfit_simulators.devices import CameraFrames, Cameras, OrientationSensor, SampleTiming
from jointfit_simulators.settings import Knobs, apply_settings, perfect
from jointfit_simulators.wires import line_noise

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_simulators.body import Observation

NO_ERRORS = perfect(Knobs())
WALK_AND_SQUATS = parse_motion_script("walk:60,squat:60")
T = np.arange(5.0, 120.0, 0.05)
NONE = np.empty(0)


def rms(lengths: ArrayLike) -> float:
    return float(np.sqrt(np.mean(np.square(lengths))))


def relative_orientations(
    knobs: Knobs, script: str = "walk:60,squat:60", t: np.ndarray = T
) -> list[Rotation]:
    """Return the true rotations from the frames of S1 to S4 to the frames of their bones."""
    subject = SimulatedSubject(knobs, parse_motion_script(script))
    found = subject.observe([t] * 4, NONE, t)
    return [
        found.truth.orientations[SENSORS[name]].inv() * Rotation.from_quat(q, scalar_first=True)
        for name, q in zip(SENSORS, found.sensors, strict=True)
    ]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_common_soft_tissue_artefact_is_equal_for_both_sensors_of_a_segment(seed: int) -> None:
    """The common part of the artefact rotates both sensors of a segment together."""
    knobs = dataclasses.replace(NO_ERRORS, soft_tissue_common_deg=5.0, seed=seed)
    s1, s2, s3, s4 = relative_orientations(knobs)
    for first, second in ((s1, s2), (s3, s4)):
        assert np.degrees(rms(first.magnitude())) == pytest.approx(5.0, rel=0.12)
        assert (first.inv() * second).magnitude().max() < 1e-9


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_single_soft_tissue_artefact_differs_between_sensors(seed: int) -> None:
    """The single part of the artefact rotates each sensor separately."""
    knobs = dataclasses.replace(NO_ERRORS, soft_tissue_sensor_deg=3.0, seed=seed)
    s1, s2, s3, s4 = relative_orientations(knobs)
    for first, second in ((s1, s2), (s3, s4)):
        assert np.degrees(rms(first.magnitude())) == pytest.approx(3.0, rel=0.12)
        assert np.degrees(rms((first.inv() * second).magnitude())) > 1.5


@pytest.mark.parametrize("share", [0.0, 0.15, 0.5])
def test_random_share_is_the_variance_that_does_not_repeat_with_posture(share: float) -> None:
    subject = SimulatedSubject(NO_ERRORS, WALK_AND_SQUATS)
    coordinates = subject._script.coordinates(T)
    artefacts = [
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
    for artefact in artefacts:
        here = artefact.at(T, coordinates)
        again = artefact.at(T + 1e4, coordinates)  # the same posture at another time
        half = np.mean(np.sum((here - again) ** 2, axis=-1)) / 2
        assert half / 0.1**2 == pytest.approx(share, rel=0.15, abs=1e-9)


def test_soft_tissue_artefact_vanishes_in_stance() -> None:
    for rotation in relative_orientations(
        dataclasses.replace(Knobs(), mount_deg=0.0), "stand", np.arange(0, 30, 0.1)
    ):
        assert np.degrees(rms(rotation.magnitude())) < 0.3


def test_sensors_and_markers_on_the_plate_move_rigidly() -> None:
    subject = SimulatedSubject(Knobs(), parse_motion_script("plate"))
    t = np.arange(0.0, 20.0, 0.1)
    found = subject.observe([t] * 4, t, t)
    plate = found.markers[:, -5:]
    distances = np.linalg.norm(plate[:, :, None] - plate[:, None], axis=-1)
    np.testing.assert_allclose(distances, distances[:1].repeat(len(t), axis=0), atol=1e-12)
    first, *others = (Rotation.from_quat(q, scalar_first=True) for q in found.sensors)
    for other in others:
        apart = first.inv() * other
        assert (apart[0].inv() * apart).magnitude().max() < 1e-9
    turned = np.degrees((first[0].inv() * first).magnitude())
    assert turned.max() > 60


def test_sensor_misalignments_are_bounded_and_differ() -> None:
    angles = np.degrees(
        [
            rotation[0].magnitude()
            for seed in range(8)
            for rotation in relative_orientations(
                dataclasses.replace(NO_ERRORS, mount_deg=20.0, seed=seed), t=T[:2]
            )
        ]
    )
    assert angles.max() <= 20.0 + 1e-9
    assert angles.max() > 15
    assert np.std(angles) > 3


def sensor_error(knobs: Knobs, name: str = "S1") -> Rotation:
    t = np.arange(0.0, 2000.0, 0.1)
    sensor = OrientationSensor(knobs, name)
    true = Rotation.random(len(t), rng=2)
    measured = sensor.report(t, true.as_quat(scalar_first=True))
    return sensor.world.inv() * Rotation.from_quat(measured, scalar_first=True) * true.inv()


@pytest.mark.parametrize("name", ["S1", "S2"])
def test_slow_and_white_orientation_errors_have_their_rms(name: str) -> None:
    slow = sensor_error(dataclasses.replace(NO_ERRORS, orientation_slow_deg=1.0), name)
    assert np.degrees(rms(slow.magnitude())) == pytest.approx(1.0, rel=0.1)
    second = np.degrees((slow[:-10].inv() * slow[10:]).magnitude())
    assert rms(second) < 0.5  # the slow error changes little in a second
    white = sensor_error(dataclasses.replace(NO_ERRORS, orientation_white_deg=0.3), name)
    assert np.degrees(rms(white.magnitude())) == pytest.approx(0.3, rel=0.05)


def test_sensor_headings_are_distributed_over_90_degrees() -> None:
    headings = []
    for seed in range(10):
        knobs = dataclasses.replace(NO_ERRORS, heading_spread_deg=90.0, seed=seed)
        for name in SENSORS:
            world = OrientationSensor(knobs, name).world.as_rotvec(degrees=True)
            assert np.abs(world[:2]).max() == 0
            headings.append(world[2])
    assert min(headings) >= 0
    assert max(headings) <= 90
    assert np.ptp(headings) > 75


def test_inclination_fault_affects_the_selected_sensor_only() -> None:
    knobs = apply_settings(NO_ERRORS, ["world_tilt_deg=90", "world_tilt_sensor=S2"])
    tilts = {n: OrientationSensor(knobs, n).world.apply([0.0, 0.0, 1.0])[2] for n in SENSORS}
    assert tilts["S2"] == pytest.approx(0, abs=1e-9)
    assert [tilts[n] for n in ("S1", "S3", "S4")] == [1, 1, 1]


def test_clock_errors_are_within_their_bounds() -> None:
    skews, now = [], 10**13
    for name in "abcdefghijkl":
        timing = SampleTiming(Knobs(), name, latency_ms=2.0, now_ns=now)
        samples = timing.samples(now, now + 100 * NS_PER_S, NS_PER_S / 100)
        gained = (
            np.polyfit((samples.host_ns - now) / NS_PER_S, (samples.device_ns - now) / NS_PER_S, 1)[
                0
            ]
            - 1
        )
        assert gained == pytest.approx(timing.clock.skew, abs=2e-7)
        skews.append(gained * 1e6)
        jitter = samples.device_ns - (samples.host_ns - timing.clock.boot_ns) * (
            1 + timing.clock.skew
        )
        assert np.std(jitter) / 1e3 == pytest.approx(20.0, rel=0.1)
        delay_ms = (samples.due_ns - samples.host_ns) / 1e6
        assert delay_ms.min() >= 2.0
        assert delay_ms.mean() - 2.0 == pytest.approx(0.5, rel=0.1)
        assert np.all(np.diff(samples.due_ns) >= 0)
        assert np.mean(samples.dropped) == pytest.approx(0.005, abs=0.003)
    assert max(np.abs(skews)) <= 50
    assert np.ptp(skews) > 40


def test_blocks_contain_every_sample_once() -> None:
    whole = SampleTiming(Knobs(), "a", latency_ms=0.0, now_ns=10**12)
    blocks = SampleTiming(Knobs(), "a", latency_ms=0.0, now_ns=10**12)
    edges = 10**12 + np.cumsum(np.r_[0, np.random.default_rng(1).integers(1, 10**8, 200)])
    parts = [blocks.samples(a, b, NS_PER_S / 400).host_ns for a, b in pairwise(edges)]
    once = whole.samples(edges[0], edges[-1], NS_PER_S / 400).host_ns
    np.testing.assert_array_equal(np.concatenate(parts), once)


@pytest.mark.parametrize("seed", [1, 4])
def test_marker_artefacts_have_their_rms(seed: int) -> None:
    base = dataclasses.replace(NO_ERRORS, seed=seed)
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
    knobs: Knobs, seconds: float = 60.0, script: str = "walk"
) -> tuple[Cameras, CameraFrames, Observation]:
    subject = SimulatedSubject(knobs, parse_motion_script(script))
    cameras = Cameras(knobs, subject, rate_hz=120.0)
    t = np.arange(0.0, seconds, 1 / 120)
    observation = subject.observe([NONE] * 4, t, t)
    return cameras, cameras.capture(observation), observation


def test_occlusions_have_their_share_and_burst_length() -> None:
    _, found, _ = frames(apply_settings(NO_ERRORS, ["occlusion=0.05"]), 200.0)
    hidden = np.isnan(found.markers[:, :, 0])
    assert hidden.mean() == pytest.approx(0.05, rel=0.15)
    begins = np.sum(~hidden[:-1] & hidden[1:])
    assert hidden.sum() / begins / 120 == pytest.approx(0.2, rel=0.15)


def test_rigid_bodies_are_fitted_to_visible_skin_markers() -> None:
    knobs = apply_settings(NO_ERRORS, ["marker_soft_tissue_mm=5", "occlusion=0.3"])
    cameras, found, observation = frames(knobs, 30.0)
    at = cameras.bodies.index("Thigh")
    columns = [cameras.markers.index(name) for name in CLUSTERS["thigh"]]
    visible = np.isfinite(found.markers[:, columns, 0]).sum(axis=1)
    lost = np.isnan(found.body_orientations[:, at, 0])
    np.testing.assert_array_equal(lost, visible < 3)
    body = Rotation.from_quat(found.body_orientations[~lost, at], scalar_first=True)
    bone = cameras.world * observation.truth.orientations["thigh"][~lost]
    apart = np.degrees((bone.inv() * body).magnitude())
    assert 80 <= np.median(apart) <= 150  # y up in the body frame, z up in the bone frame
    relative = bone.inv() * body
    artefact_deg = np.degrees((relative.mean().inv() * relative).magnitude())
    assert 0.3 < rms(artefact_deg) < 6  # soft-tissue artefact


def test_rigid_bodies_without_errors_follow_their_bones() -> None:
    cameras, found, observation = frames(NO_ERRORS, 10.0, "functional")
    for part in ("pelvis", "thigh", "shank", "foot"):
        at = cameras.bodies.index(part.capitalize())
        body = Rotation.from_quat(found.body_orientations[:, at], scalar_first=True)
        relative = (cameras.world * observation.truth.orientations[part]).inv() * body
        assert (relative[0].inv() * relative).magnitude().max() < 1e-6
    plate = found.body_orientations[:, cameras.bodies.index("Plate")]
    np.testing.assert_allclose(np.abs(plate[0]), [np.sqrt(0.5), np.sqrt(0.5), 0, 0], atol=1e-9)


def test_optical_world_is_rotated_about_the_vertical() -> None:
    cameras, found, observation = frames(
        apply_settings(NO_ERRORS, ["optical_heading_deg=180"]), 1.0, "stand"
    )
    assert abs(cameras.heading_rad) > 0.05
    np.testing.assert_allclose(found.markers[:, :, 2], observation.markers[:, :, 2], atol=1e-12)
    flat = np.linalg.norm(found.markers[:, :, :2], axis=-1)
    np.testing.assert_allclose(flat, np.linalg.norm(observation.markers[:, :, :2], axis=-1))


def test_line_noise_has_its_share_of_flipped_bytes_and_bursts() -> None:
    data = bytes(1000)
    flips = line_noise(apply_settings(NO_ERRORS, ["line_flip_per_byte=0.01"]), "S1")
    noisy = b"".join(flips(data) for _ in range(100))
    assert len(noisy) == 100_000
    assert np.count_nonzero(np.frombuffer(noisy, np.uint8)) == pytest.approx(1000, rel=0.15)
    bursts = line_noise(
        apply_settings(NO_ERRORS, ["line_burst_per_byte=0.01", "line_burst_bytes=16"]), "S1"
    )
    longer = sum(len(bursts(data)) - 1000 for _ in range(100))
    assert longer == pytest.approx(1000 * 8.5, rel=0.2)
    assert line_noise(NO_ERRORS, "S1")(data) is data


def test_measurements_depend_on_the_seed_only() -> None:
    def run(seed: int) -> np.ndarray:
        knobs = dataclasses.replace(Knobs(), seed=seed)
        subject = SimulatedSubject(knobs, WALK_AND_SQUATS)
        found = subject.observe([T] * 4, T, T)
        measured = [
            OrientationSensor(knobs, name).report(T, q)
            for name, q in zip(SENSORS, found.sensors, strict=True)
        ]
        markers = Cameras(knobs, subject, rate_hz=120.0).capture(found).markers
        return np.concatenate([*map(np.ravel, measured), np.ravel(markers)])

    np.testing.assert_array_equal(run(3), run(3))
    assert not np.allclose(run(3), run(4), equal_nan=True)


def test_changed_setting_does_not_affect_other_random_draws() -> None:
    one, other = (
        relative_orientations(apply_settings(NO_ERRORS, [f"mount_deg={d}"]), t=T[:5])
        for d in (10, 20)
    )
    for small, large in zip(one, other, strict=True):
        np.testing.assert_allclose(2 * small.as_rotvec(), large.as_rotvec(), atol=1e-9)


def test_random_signal_does_not_depend_on_the_order_and_is_band_limited() -> None:
    signal = RandomSignal(np.random.default_rng(1), 2, low_hz=0.5, high_hz=2.0, rms=3.0)
    t = np.arange(0, 400, 0.05)
    found = signal.at(t)
    np.testing.assert_allclose(signal.at(t[::-1])[::-1], found, atol=1e-9)
    assert np.sqrt(np.mean(found**2, axis=0)) == pytest.approx([3.0, 3.0], rel=0.05)
    power = np.abs(np.fft.rfft(found[:, 0])) ** 2
    hertz = np.fft.rfftfreq(len(t), 0.05)
    inside = (hertz > 0.45) & (hertz < 2.05)
    assert power[inside].sum() / power.sum() > 0.98


def test_unknown_setting_is_rejected_with_the_nearest_name() -> None:
    with pytest.raises(ValueError, match="did you mean 'dropout'"):
        apply_settings(Knobs(), ["dropot=1"])
    with pytest.raises(ValueError, match="expected float"):
        apply_settings(Knobs(), ["dropout=much"])
