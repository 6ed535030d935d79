"""Sessions of a simulated subject as arrays, with errors of known size, and true angles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.session_data import (
    JointSeries,
    MarkerSeries,
    SegmentSeries,
    SensorSeries,
    SessionData,
    TimelineEvent,
)
from jointfit_simulators.body import Rotation, SimulatedSubject, Step, random_vector_signal, to_wxyz
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array

RATE_HZ = 100.0
CAMERA_HZ = 120.0
STRIDE_S = 1.1
"""Duration of a stride of the simulated subject, s. Its multiples are the times of heel strikes."""
ERROR_RAD = np.radians(1.2)
"""Published standard deviation of the orientations per axis, rad. The simulated errors have about
0.9 times this standard deviation, and those of the cameras about 0.3 times.
"""
ANGLES = ("flexion", "adduction", "rotation")
JOINTS = {
    "leg": {"knee": ("thigh", "shank", -1)},
    "legs": {
        "right_hip": ("pelvis", "right_thigh", 1),
        "right_knee": ("right_thigh", "right_shank", -1),
        "left_hip": ("pelvis", "left_thigh", 1),
        "left_knee": ("left_thigh", "left_shank", -1),
    },
}
"""Joints with their proximal and distal segments, and the sign of flexion about x."""


def simulated_session(
    steps: Sequence[Step] = (Step("walk", 20.0),),
    *,
    seed: int = 1,
    limb: str = "leg",
    cameras: bool = True,
    gap_s: tuple[float, float] | None = None,
) -> SessionData:
    """Return a session with errors in proportion to `ERROR_RAD`; sensor S1 is silent in `gap_s`."""
    subject = SimulatedSubject(Knobs(seed=seed), steps, limb=limb)
    duration_s = sum(step.seconds for step in steps)
    t_s, camera_s = np.arange(0.0, duration_s, 1 / RATE_HZ), np.arange(0, duration_s, 1 / CAMERA_HZ)
    observed = subject.observe([t_s] * len(subject.sensors), camera_s, t_s)
    optical = subject.observe([np.empty(0)] * len(subject.sensors), np.empty(0), camera_s).truth
    parts = sorted({name for pair in JOINTS[limb].values() for name in pair[:2]})

    true = observed.truth.orientations
    estimated = {
        name: true[name] * _error(Knobs(seed=seed).random(name), t_s, 0.9 * ERROR_RAD)
        for name in parts
    }
    seen = {
        name: optical.orientations[name]
        * _error(Knobs(seed=seed).random(f"cameras {name}"), camera_s, 0.3 * ERROR_RAD)
        for name in parts
    }
    silent = np.zeros(len(t_s), bool) if gap_s is None else (t_s > gap_s[0]) & (t_s < gap_s[1])
    sd = np.full(len(t_s), ERROR_RAD)
    return SessionData(
        name="bench-1",
        start_unix_ns=1_795_250_060_000_000_000,
        sensors=tuple(
            SensorSeries(sensor, segment, t_s[kept], q[kept])
            for (sensor, segment), q in zip(subject.sensors.items(), observed.sensors, strict=True)
            for kept in [~silent if sensor == "S1" else np.ones(len(t_s), bool)]
        ),
        markers=_markers(subject, camera_s, observed.markers) if cameras else None,
        segments=tuple(SegmentSeries(name, t_s, to_wxyz(q), sd) for name, q in estimated.items()),
        joints=_joints(limb, t_s, estimated, np.sqrt(2) * sd),
        optical_segments=tuple(
            SegmentSeries(name, camera_s, to_wxyz(q)) for name, q in seen.items() if cameras
        ),
        optical_joints=_joints(limb, camera_s, seen, None) if cameras else (),
        events=_events(steps, gap_s),
        description={
            "rig": "bench-1",
            "limb": limb,
            "subject": f"P{seed:02d}",
            "software": "jointfitd 0.1.0",
            "calibration": "version 3, 2026-11-23 09:12",
            "recording": "bench-1-20261123T091420-0001.mcap",
        },
    )


def true_angle(steps: Sequence[Step], seed: int, limb: str, joint: str, t_s: Array) -> Array:
    """Return the true flexion of a joint, rad, shape (n,)."""
    subject = SimulatedSubject(Knobs(seed=seed), steps, limb=limb)
    truth = subject.observe([np.empty(0)] * len(subject.sensors), np.empty(0), t_s).truth
    angles = _joints(limb, t_s, dict(truth.orientations), None)
    return next(series for series in angles if series.name == joint).angles["flexion"]


def _error(random: np.random.Generator, t_s: Array, rms: float) -> Rotation:
    slow = random_vector_signal(random, 1, low_hz=0.02, high_hz=0.5, rms=rms * np.sqrt(3.0))
    white = random.normal(0.0, 0.15 * ERROR_RAD, (len(t_s), 3))
    return Rotation.from_rotvec(slow.at(t_s).reshape(-1, 3) + white)


def _joints(
    limb: str, t_s: Array, orientations: dict[str, Rotation], sd: Array | None
) -> tuple[JointSeries, ...]:
    series = []
    for joint, (proximal, distal, sign) in JOINTS[limb].items():
        mirror = -1 if joint.startswith("left") else 1
        euler = (orientations[proximal].inv() * orientations[distal]).as_euler("XYZ")
        angles = dict(zip(ANGLES, (euler * [sign, mirror, mirror]).T, strict=True))
        series.append(JointSeries(joint, t_s, angles, {} if sd is None else {"flexion": sd}))
    return tuple(series)


def _markers(subject: SimulatedSubject, t_s: Array, positions: Array) -> MarkerSeries:
    labels = tuple(label for cluster in subject.clusters.values() for label in cluster)
    return MarkerSeries(labels, t_s, positions[:, : len(labels)])


def _events(steps: Sequence[Step], gap_s: tuple[float, float] | None) -> tuple[TimelineEvent, ...]:
    events, start_s = [], 0.0
    for step in steps:
        events.append(TimelineEvent(start_s, "mark", "", f"{step.name}"))
        start_s += step.seconds
    for source, skew in (("S1", 12.4), ("S2", -3.1), ("S3", 20.7), ("S4", 1.8)):
        clock = {"sd_us": 38.0, "skew_ppm": skew, "jitter_us": 410.0}
        events.append(TimelineEvent(start_s, "clock", source, data=clock))
    latency = {"median_ms": 6.1, "p95_ms": 9.8, "max_ms": 24.3}
    events.append(TimelineEvent(start_s, "latency", data=latency))
    errors = {"thigh": {"anchored": 0.024}, "shank": {"anchored": 0.037}}
    holdout = {"method": "anchored", "segments": errors, "flexion": {"knee": {"anchored": 0.033}}}
    anatomy = {"joints": {"hip": {"sd_m": 0.012}, "knee": {"sd_m": 0.009}, "ankle": {"sd_m": None}}}
    quality = {"holdout": holdout, "anatomy": anatomy}
    events.append(
        TimelineEvent(0.0, "calibration", "calibrated", "version 3", {"quality": quality})
    )
    if gap_s is not None:
        events.append(
            TimelineEvent(
                gap_s[0], "device", "S1", "no data: check its cable", {"level": "warning"}
            )
        )
    return tuple(sorted(events, key=lambda event: event.t_s))
