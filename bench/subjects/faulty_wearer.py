"""Simulated subjects with faulty sensors, and their fused results.

Invariant: the bones are known. The calibration is made by the code of the daemon before the fault.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from bench.subjects.simulated_wearer import bench_rig, phases
from jointfit_daemon.calibration import CalibrationError
from jointfit_daemon.calibration.phases import fit_calibration, fit_plate_alignment
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.body import SENSORS, Rotation, SimulatedSubject, Step, from_wxyz, to_wxyz
from jointfit_simulators.devices import Cameras, OrientationSensor
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.fusion import LimbFuser, SensorReport
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import LimbState

BEGIN_S = 100.0
"""Start of the live part, s. Errors and soft-tissue artefact change with time, so the live part is
later than the calibration."""
MOVES = ("walk", "squat", "sit_to_stand", "stand")
MOVE_S = 15.0
SEGMENTS = ("thigh", "shank")
PULL_S, STAY_S = 5.0, 30.0
"""Rise and fall time of a magnetic disturbance, and its duration between them, s."""


@dataclass(frozen=True, slots=True)
class SubjectRecording:
    """Orientations of the sensors and bones of one subject in motion."""

    t_s: Array
    """Time from 0, shape (n,), s."""
    orientations: Mapping[str, Array]
    """Orientations q_world_sensor by sensor, shape (n, 4); NaN without a sample."""
    bones: Mapping[str, Array]
    """Orientations q_optical_segment by segment, shape (n, 4)."""
    flexion: Array
    """Knee flexion, rad."""

    def with_orientations(self, name: str, q: Array) -> SubjectRecording:
        """Return a copy in which `q` replaces the samples of one sensor."""
        return SubjectRecording(self.t_s, {**self.orientations, name: q}, self.bones, self.flexion)


@cache
def calibrated(seed: int) -> Calibration | None:
    """Return the calibration of one subject; None if the calibration is refused."""
    rig, trials = bench_rig(), phases(seed)
    alignment = fit_plate_alignment(trials.align, rig.calibration)
    try:
        return fit_calibration(
            trials.static, trials.functional, alignment, rig.calibration, rig.chain
        )
    except CalibrationError:
        return None


@cache
def live(seed: int, seconds: float, rate_hz: float, begin_s: float = BEGIN_S) -> SubjectRecording:
    """Return the recording of walking, squats, sit-to-stand and standing, in turn."""
    knobs = Knobs(seed=seed)
    count = -(-int(seconds) // int(MOVE_S))
    steps = [Step(MOVES[k % len(MOVES)], MOVE_S) for k in range(count)]
    wearer = SimulatedSubject(knobs, [Step("stand", begin_s), *steps])
    t_s = np.arange(begin_s, begin_s + seconds, 1 / rate_hz)
    seen = wearer.observe([t_s] * len(SENSORS), np.empty(0), t_s)
    world = Cameras(knobs, wearer, rate_hz=knobs.mocap_hz).world
    orientations = {
        name: OrientationSensor(knobs, name).report(t_s, q)
        for name, q in zip(SENSORS, seen.sensors, strict=True)
    }
    bones = {name: to_wxyz(world * seen.truth.orientations[name]) for name in SEGMENTS}
    return SubjectRecording(t_s - begin_s, orientations, bones, seen.truth.angles[:, 0])


def stuck(person: SubjectRecording, name: str, at_s: float) -> SubjectRecording:
    """Return a copy in which a sensor repeats its last orientation from `at_s` on."""
    q = person.orientations[name]
    first = int(np.searchsorted(person.t_s, at_s))
    return person.with_orientations(name, np.where(np.arange(len(q))[:, None] < first, q, q[first]))


def silent(person: SubjectRecording, name: str, at_s: float) -> SubjectRecording:
    """Return a copy in which a sensor sends nothing from `at_s` on."""
    q = np.where(person.t_s[:, None] < at_s, person.orientations[name], np.nan)
    return person.with_orientations(name, q)


def slipped(
    person: SubjectRecording, name: str, at_s: float, angle_rad: float, seed: int
) -> SubjectRecording:
    """Return a copy in which a sensor slips by an angle about a random axis within 0.3 s."""
    axis = np.random.default_rng(seed).normal(size=3)
    axis /= np.linalg.norm(axis)
    share = np.clip((person.t_s - at_s) / 0.3, 0.0, 1.0)
    slide = Rotation.from_rotvec(angle_rad * share[:, None] * axis)
    return person.with_orientations(name, to_wxyz(from_wxyz(person.orientations[name]) * slide))


def drifting(person: SubjectRecording, names: Sequence[str], rate_rad_s: float) -> SubjectRecording:
    """Return a copy in which the worlds of some sensors rotate about the vertical."""
    for name in names:
        turn = rotation.heading(rate_rad_s * person.t_s)
        person = person.with_orientations(name, rotation.multiply(turn, person.orientations[name]))
    return person


def pulled(
    person: SubjectRecording, names: Sequence[str], at_s: float, angle_rad: float
) -> SubjectRecording:
    """Return a copy with a magnetic disturbance: headings deviate for 30 s and return.

    The deviation rises and falls within :data:`PULL_S`, as in an orientation filter with a time
    constant of a few seconds.
    """
    begin, end = (person.t_s - at_s) / PULL_S, (person.t_s - at_s - PULL_S - STAY_S) / PULL_S
    turn = rotation.heading(angle_rad * (_smooth(begin) - _smooth(end)))
    for name in names:
        person = person.with_orientations(name, rotation.multiply(turn, person.orientations[name]))
    return person


def _smooth(share: Array) -> Array:
    """Return a smooth step from 0 to 1 that rises with `share`."""
    x = np.clip(share, 0.0, 1.0)
    return np.asarray(x * x * (3.0 - 2.0 * x))


def play(
    fuser: LimbFuser, person: SubjectRecording
) -> tuple[list[LimbState], list[tuple[float, SensorReport]]]:
    """Return the fused result of every frame, and the events with their times (s)."""
    rows = {
        name: [(w, x, y, z) for w, x, y, z in q.tolist()] for name, q in person.orientations.items()
    }
    states, reports = [], []
    for k, t_s in enumerate(person.t_s.tolist()):
        t_ns = round((BEGIN_S + t_s) * NS_PER_S)
        samples = {name: q[k] for name, q in rows.items() if q[k][0] == q[k][0]}  # NaN is no sample
        states.append(fuser.fuse(t_ns, t_ns, k, samples))
        reports += [(t_s, report) for report in fuser.pop_reports(t_ns)]
    return states, reports


def segment_orientations(states: Sequence[LimbState], segment: int) -> Array:
    """Return the orientations q_world_segment, shape (n, 4)."""
    return np.array([state.segments[segment].q_world_segment for state in states])


def jumps(before: Sequence[LimbState], after: Sequence[LimbState], segment: int) -> Array:
    """Return the change of the output that a fault causes, relative to the predicted RMS error.

    `before` and `after` are the states without and with the fault. The result has the shape (n,).
    """
    predicted = np.array([state.segments[segment].sd for state in after], dtype=np.float64)
    moved = rotation.angle_between(
        segment_orientations(before, segment), segment_orientations(after, segment)
    )
    return np.asarray(moved / (np.sqrt(3.0) * predicted))


def joint_errors(states: Sequence[LimbState], person: SubjectRecording) -> Array:
    """Return the angle between the estimated and the true knee rotation, rad, shape (n,)."""
    above, below = (
        rotation.conjugate(segment_orientations(states, 0)),
        segment_orientations(states, 1),
    )
    true = rotation.multiply(rotation.conjugate(person.bones["thigh"]), person.bones["shank"])
    return rotation.angle_between(rotation.multiply(above, below), true)
