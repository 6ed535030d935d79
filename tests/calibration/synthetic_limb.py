"""A leg of known geometry for tests. It is simulated with SciPy, without algorithms of the project.

The segment axes are defined in CONVENTIONS.md: x points to the right, y forward, z up. The origin
is the proximal joint center.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from jointfit_daemon.calibration import (
    CalibrationSettings,
    CalibrationTrial,
    OpticalTrack,
    SensorTrack,
)
from jointfit_daemon.model import Chain

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

CHAIN = Chain(
    joints=("hip", "knee", "ankle"),
    segments=("thigh", "shank"),
    sensors=(("S1", "S2"), ("S3", "S4")),
    proximal="pelvis",
    distal="foot",
)
OWNER = {"S1": "thigh", "S2": "thigh", "S3": "shank", "S4": "shank"}
LENGTH = {"thigh": 0.42, "shank": 0.40}
LOCAL = {  # markers in segment coordinates, m
    "pelvis": [[-0.02, 0.1, 0.09], [-0.22, 0.1, 0.09], [-0.05, -0.12, 0.1], [-0.2, -0.12, 0.1]],
    "thigh": [[0.07, 0.03, -0.15], [0.02, 0.08, -0.2], [-0.06, 0.05, -0.27], [0.06, -0.03, -0.3]],
    "shank": [[0.05, 0.02, -0.12], [0.01, 0.06, -0.2], [-0.05, 0.02, -0.16], [0.04, 0.0, -0.3]],
    "foot": [[0.04, 0.12, -0.05], [-0.04, 0.11, -0.05], [0.0, -0.06, -0.04], [0.03, 0.03, -0.01]],
}
MARKERS = {part: tuple(f"{part}{i}" for i in range(4)) for part in LOCAL}
SETTINGS = CalibrationSettings(markers=MARKERS, plate="Plate")


@dataclass(frozen=True)
class Imperfections:
    """Errors of sensors and markers."""

    marker_m: float = 0.0005
    skin_m: float = 0.0
    sensor_deg: float = 0.05
    tissue_deg: float = 0.0
    heading_deg: float = 90.0
    lag_s: float = 0.0
    occluded: float = 0.0


@dataclass(frozen=True)
class Subject:
    """One subject with alignments, sensor worlds, facing direction and soft tissue.

    All trials of a subject have the same values.
    """

    seed: int = 0
    facing: float = 0.7
    flaws: Imperfections = field(default_factory=Imperfections)

    def rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, purpose])

    def mounts(self) -> dict[str, Rotation]:
        rng = self.rng(1)
        return {s: Rotation.random(random_state=rng) for s in OWNER}

    def worlds(self) -> dict[str, Rotation]:
        """q_optical_sensorworld of every sensor."""
        rng, most = self.rng(2), np.radians(self.flaws.heading_deg)
        return {s: Rotation.from_rotvec([0, 0, rng.uniform(-most, most)]) for s in OWNER}


@dataclass(frozen=True)
class Motion:
    """True orientations and positions of the bones at the instants `t_s`."""

    t_s: Array
    q: dict[str, Rotation]
    p: dict[str, Array]
    """Origin of every part: pelvis and thigh at the hip, shank at the knee, foot at the ankle."""
    angles: Array
    """Flexions of hip, knee, ankle, rad, shape (n, 3)."""


def motion(subject: Subject, seconds: float, rate_hz: float, *, still: bool = False) -> Motion:
    """Return walking, squats and hip circles in turn, with standing at the start and the end."""
    t = np.arange(round(seconds * rate_hz)) / rate_hz
    calm = 0.0 if still else 1.0
    hip, adduction, turn, knee, ankle, sway = calm * _program(t, seconds)
    facing = Rotation.from_rotvec([0, 0, subject.facing])
    wander = Rotation.from_rotvec(
        np.stack((0.1 * sway, 0.05 * np.sin(0.9 * t) * calm, 0.4 * sway), axis=1)
    )
    pelvis = facing * wander
    thigh = pelvis * Rotation.from_euler("XYZ", np.stack((hip, adduction, turn), axis=1))
    wobble = 0.1 * np.sin(knee)
    shank = thigh * Rotation.from_euler("XYZ", np.stack((-knee, 0.3 * wobble, wobble), axis=1))
    foot = shank * Rotation.from_euler("XYZ", np.stack((ankle, 0 * ankle, 0.2 * ankle), axis=1))
    hips = np.stack((0.2 * sway, 0.3 * sway, 0.9 - 0.2 * (1 - np.cos(hip))), axis=1)
    knees = hips + thigh.apply([0, 0, -LENGTH["thigh"]])
    ankles = knees + shank.apply([0, 0, -LENGTH["shank"]])
    q = {"pelvis": pelvis, "thigh": thigh, "shank": shank, "foot": foot}
    p = {"pelvis": hips, "thigh": hips, "shank": knees, "foot": ankles}
    return Motion(t, q, p, np.stack((hip, knee, ankle), axis=1))


def _program(t: Array, seconds: float) -> Array:
    """Return hip flexion, adduction, rotation, knee and ankle flexion, sway, shape (6, n)."""
    turns = np.floor(t / 5.0).astype(int) % 3  # the kind of movement changes every five seconds
    edge = np.minimum(t, seconds - t)
    gate = np.clip(edge / 0.8, 0, 1)
    gate = gate**2 * (3 - 2 * gate)
    fade = np.abs(np.sin(np.pi * t / 5.0)) ** 0.5 * gate
    walk, squat, circle = (fade * (turns == k) for k in range(3))
    a = 2 * np.pi * t
    hip = walk * 0.4 * np.sin(0.9 * a) + squat * 0.6 * (1 - np.cos(0.35 * a))
    hip = hip + circle * 0.35 * np.sin(0.6 * a)
    adduction = 0.08 * walk * np.sin(0.9 * a + 1) + circle * 0.35 * np.cos(0.6 * a)
    turn = 0.06 * walk * np.cos(0.9 * a) + circle * 0.15 * np.sin(1.3 * a)
    knee = walk * 0.5 * (1 - np.cos(0.9 * a + 0.5)) + squat * 0.8 * (1 - np.cos(0.35 * a))
    knee = knee + circle * 0.2 * (1 - np.cos(0.8 * a))
    ankle = walk * 0.25 * np.sin(0.9 * a + 2) + squat * 0.2 * (1 - np.cos(0.35 * a))
    ankle = ankle + circle * 0.3 * np.sin(0.7 * a)
    sway = gate * np.sin(0.31 * a / 3) * 0.5
    return np.stack((hip, adduction, turn, knee, ankle, sway))


def record(
    subject: Subject, truth: Motion, purpose: int, *, sensors: bool = True, cameras: bool = True
) -> CalibrationTrial:
    """Return the trial of a motion, with sensors at 100 Hz and cameras at 120 Hz."""
    tracks = _sensors(subject, truth, purpose) if sensors else {}
    return CalibrationTrial(tracks, _optical(subject, truth, purpose) if cameras else None)


def _sensors(subject: Subject, truth: Motion, purpose: int) -> dict[str, SensorTrack]:
    rng, flaws = subject.rng(100 + purpose), subject.flaws
    mounts, worlds = subject.mounts(), subject.worlds()
    t = np.arange(truth.t_s[0], truth.t_s[-1] - flaws.lag_s, 0.01)
    knee, hip = (np.interp(t, truth.t_s, truth.angles[:, k]) for k in (1, 0))
    out = {}
    for i, (name, part) in enumerate(OWNER.items()):
        bone = Slerp(truth.t_s, truth.q[part])(t)
        skin = np.random.default_rng([subject.seed, 7, i]).normal(size=(2, 3))
        slip = np.radians(flaws.tissue_deg) * (np.outer(knee, skin[0]) + np.outer(hip, skin[1]))
        noise = np.radians(flaws.sensor_deg) * rng.normal(size=(len(t), 3))
        q = worlds[name].inv() * bone * Rotation.from_rotvec(slip + noise) * mounts[name].inv()
        stamps = np.round((t + flaws.lag_s) * 1e9).astype(np.int64)
        out[name] = SensorTrack(stamps, q.as_quat(scalar_first=True))
    return out


def _optical(subject: Subject, truth: Motion, purpose: int) -> OpticalTrack:
    rng, flaws = subject.rng(200 + purpose), subject.flaws
    t = np.arange(truth.t_s[0], truth.t_s[-1], 1 / 120)
    knee = np.interp(t, truth.t_s, truth.angles[:, 1])
    names: list[str] = []
    columns: list[Array] = []
    for part, local in LOCAL.items():
        bone = Slerp(truth.t_s, truth.q[part])(t)
        place = np.stack([np.interp(t, truth.t_s, truth.p[part][:, k]) for k in range(3)], axis=1)
        for i, where in enumerate(np.array(local)):
            skin = np.random.default_rng([subject.seed, 8, len(names)])
            way, phase = skin.normal(size=(2, 3)) / np.sqrt(3), skin.uniform(0, 2 * np.pi)
            slide = np.outer(knee, way[0]) + np.outer(np.sin(3 * t + phase) - np.sin(phase), way[1])
            slide = flaws.skin_m * slide * (np.ptp(knee) > 0)
            noise = flaws.marker_m * rng.normal(size=(len(t), 3))
            columns.append(bone.apply(where + slide) + place + noise)
            names.append(MARKERS[part][i])
    positions = np.stack(columns, axis=1)
    positions[rng.uniform(size=positions.shape[:2]) < flaws.occluded] = np.nan
    return optical_track(t, positions, tuple(names))


def optical_track(t_s: Array, positions: Array, names: tuple[str, ...]) -> OpticalTrack:
    """Return a track of markers without bodies."""
    stamps = np.round(t_s * 1e9).astype(np.int64)
    n = len(t_s)
    return OpticalTrack(stamps, names, positions, (), np.zeros((n, 0, 3)), np.zeros((n, 0, 4)))


def static_and_functional(
    subject: Subject, seconds: float = 30.0
) -> tuple[CalibrationTrial, CalibrationTrial, Motion]:
    """Return the two trials of a calibration and the true motion of the second, at 400 Hz."""
    standing = motion(subject, 6.0, 400.0, still=True)
    moving = motion(subject, seconds, 400.0)
    return record(subject, standing, 1), record(subject, moving, 2), moving


def plate_trial(subject: Subject, seconds: float = 30.0, *, axes: int = 3) -> CalibrationTrial:
    """Return the align phase: the plate turned by hand about 1, 2 or 3 axes."""
    flaws, rng = subject.flaws, subject.rng(3)
    t = np.arange(0, seconds, 1 / 200)
    wave = [0.9 * np.sin((0.8 + 0.37 * k) * 2.1 * t + 0.4 * np.sin(0.9 * t + k)) for k in range(3)]
    vectors = np.stack([w if k < axes else 0 * t for k, w in enumerate(wave)], axis=1)
    plate = Rotation.from_rotvec(vectors) * Rotation.random(random_state=rng)
    mounts, worlds = {s: Rotation.random(random_state=rng) for s in OWNER}, subject.worlds()
    ts = np.arange(0.5, seconds - 0.5, 0.01)
    sensors = {}
    for name in OWNER:
        noise = Rotation.from_rotvec(np.radians(flaws.sensor_deg) * rng.normal(size=(len(ts), 3)))
        q = worlds[name].inv() * Slerp(t, plate)(ts) * noise * mounts[name]
        stamps = np.round((ts + flaws.lag_s) * 1e9).astype(np.int64)
        sensors[name] = SensorTrack(stamps, q.as_quat(scalar_first=True))
    tc = np.arange(0, seconds - 0.02, 1 / 120)
    seen = Slerp(t, plate)(tc).as_quat(scalar_first=True)[:, None]
    seen[rng.uniform(size=len(tc)) < flaws.occluded] = np.nan
    stamps = np.round(tc * 1e9).astype(np.int64)
    body = np.zeros((len(tc), 1, 3))
    optical = OpticalTrack(stamps, (), np.zeros((len(tc), 0, 3)), ("Plate",), body, seen)
    return CalibrationTrial(sensors, optical)
