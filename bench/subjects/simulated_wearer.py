"""Simulated subject without wire formats: trials, a calibration and a stream of samples.

Invariant: subject and sensors of the simulator have one clock. The same settings and seed as in a
`jointfit-sim` process yield the same subject with the same alignments. A calibration from this
module therefore fits the devices of the simulator.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration import CalibrationTrial, OpticalTrack, SensorTrack
from jointfit_daemon.calibration.phases import fit_calibration, fit_plate_alignment
from jointfit_daemon.config import parse_rig
from jointfit_daemon.units import NS_PER_S
from jointfit_simulators.body import LIMBS, SENSORS, SimulatedSubject, Step
from jointfit_simulators.devices import CameraFrames, Cameras, OrientationSensor
from jointfit_simulators.scene import RigOptions, rig_toml
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.model import Quaternion
    from jointfit_simulators.body import LegGeometry

MOVES = {
    "leg": ("functional", "walk", "squat", "sit_to_stand"),
    "legs": ("functional", "walk", "squat", "sit_to_stand"),
    "arm": ("functional",),
    "trunk": ("functional",),
}
"""Motions of the functional calibration, by limb. All motions have the same duration."""
PLATE_S, STAND_S, FUNCTIONAL_S = 24.0, 9.0, 60.0
_CAN_BLOCKS = 7
"""Number of the last block of 256 identifiers in the range of 11-bit identifiers."""
_LEAD_S = 2.0
"""Time at the start of a trial that is not used, s, because of the transition between motions."""


@dataclass(frozen=True)
class Phases:
    """The three trials of a calibration."""

    align: CalibrationTrial
    static: CalibrationTrial
    functional: CalibrationTrial


@cache
def phases(seed: int = 1, rate_hz: float = 100.0, limb: str = "leg") -> Phases:
    """Return the trials of one subject: 22 s on the plate, 7 s of standing, 60 s of movement."""
    return phases_of(Knobs(seed=seed, rate_hz=rate_hz), limb)


def phases_of(knobs: Knobs, limb: str = "leg", geometry: LegGeometry | None = None) -> Phases:
    """Return the trials of a subject with given error settings and bones."""
    rate_hz, moves = knobs.rate_hz, MOVES[limb]
    steps = [Step("plate", PLATE_S), Step("stand", STAND_S)]
    steps += [Step(name, FUNCTIONAL_S / len(moves)) for name in moves]
    wearer = SimulatedSubject(knobs, steps, limb=limb, geometry=geometry)
    end_s = PLATE_S + STAND_S + FUNCTIONAL_S
    imu_s = np.arange(0.0, end_s, 1 / rate_hz)
    camera_s = np.arange(0.0, end_s, 1 / knobs.mocap_hz)
    seen = wearer.observe([imu_s] * len(wearer.sensors), camera_s, imu_s[:1])
    said = {
        name: OrientationSensor(knobs, name).report(imu_s, q)
        for name, q in zip(wearer.sensors, seen.sensors, strict=True)
    }
    cameras = Cameras(knobs, wearer, rate_hz=knobs.mocap_hz)
    frames = cameras.capture(seen)

    def cut(begin_s: float, length_s: float) -> CalibrationTrial:
        low, high = begin_s + _LEAD_S, begin_s + length_s
        now = (imu_s >= low) & (imu_s < high)
        sensors = {name: SensorTrack(_ns(imu_s[now]), q[now]) for name, q in said.items()}
        shot = (camera_s >= low) & (camera_s < high)
        return CalibrationTrial(sensors, _track(cameras, frames, camera_s, shot))

    return Phases(
        cut(0.0, PLATE_S),
        cut(PLATE_S, STAND_S),
        cut(PLATE_S + STAND_S - _LEAD_S, FUNCTIONAL_S + _LEAD_S),
    )


def _ns(t_s: Array) -> NDArray[np.int64]:
    return np.round(t_s * NS_PER_S).astype(np.int64)


def _track(
    cameras: Cameras, frames: CameraFrames, camera_s: Array, shot: NDArray[np.bool_]
) -> OpticalTrack:
    return OpticalTrack(
        _ns(camera_s[shot]),
        cameras.markers,
        frames.markers[shot],
        cameras.bodies,
        frames.body_positions[shot],
        frames.body_orientations[shot],
    )


def fitted(rig: Rig, seed: int = 1) -> Calibration:
    """Return the calibration of this subject for `rig`."""
    trials = phases(seed)
    settings = rig.calibration
    alignment = fit_plate_alignment(trials.align, settings)
    return fit_calibration(trials.static, trials.functional, alignment, settings, rig.chain)


def bench_rig(rate_hz: float = 100.0, limb: str = "leg") -> Rig:
    """Return the rig of a simulated limb, with ports that are never opened."""
    baud = 115_200 if rate_hz <= 100.0 else 921_600  # 400 Hz requires 188 kbit/s

    tables = ['[can.can0]\ninterface = "slcan"\nchannel = "/dev/null"\n']
    for number, (name, segment) in enumerate(LIMBS[limb].sensors.items(), 1):
        head = f'[[imu]]\nid = "{name}"\nsegment = "{segment}"\nrate_hz = {rate_hz:g}\n'
        if number % 2 or number > _CAN_BLOCKS:
            tables.append(f'{head}driver = "xbus"\nport = "/dev/{name}"\nbaud = {baud}\n')
            continue
        block = number << 8
        ids = f"sample_time = {block + 5}, group_counter = {block + 6}, quaternion = {block + 33}"
        tables.append(f'{head}driver = "xcdi"\ncan = "can0"\nids = {{ {ids} }}\n')
    text = rig_toml(
        RigOptions(name="bench"),
        devices=tables,
        mocap='[mocap]\ndriver = "natnet"\nserver = "127.0.0.1"\nup_axis = "y"',
        clusters=LIMBS[limb].clusters,
        bones=(),
        plate=True,
        chain=LIMBS[limb].chain,
    )
    return parse_rig(tomllib.loads(text))


def walking(sensor: str, rate_hz: float, seconds: float) -> list[Quaternion]:
    """Return the orientations q_world_sensor of one sensor during walking."""
    knobs = Knobs(rate_hz=rate_hz)
    t_s = np.arange(0.0, seconds, 1 / rate_hz)
    streams = [t_s if name == sensor else t_s[:0] for name in SENSORS]
    seen = SimulatedSubject(knobs, [Step("walk", seconds)]).observe(streams, t_s[:1], t_s[:1])
    q = seen.sensors[list(SENSORS).index(sensor)]
    return [tuple(row) for row in OrientationSensor(knobs, sensor).report(t_s, q).tolist()]
