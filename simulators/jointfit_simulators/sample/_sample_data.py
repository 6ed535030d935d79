"""Sample data for every command that reads files, from short trials of one leg.

Invariant: equal seeds produce equal files. Sensors, cameras and reference have one common world
frame, and all streams of a trial have one common clock, as in an edited recording. Soft-tissue
artefact, sensor alignment, sensor errors, marker noise and occlusion have the default settings, but
the markers of the planar trial have no soft-tissue artefact.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, NamedTuple, cast

import numpy as np

from jointfit_daemon.files.mocap import MarkerTrajectories, c3d_bytes, write_trc
from jointfit_daemon.files.orientations import (
    OrientationTable,
    OrientationTrial,
    write_orientations_npz,
    write_orientations_sto,
)
from jointfit_protocols.xcdi import XcdiIds
from jointfit_simulators.body import (
    PARTS,
    SimulatedSubject,
    Step,
    leg_parts,
    misplaced_markers,
    model_osim,
    model_toml,
    to_wxyz,
)
from jointfit_simulators.devices import Cameras, OrientationSensor, XcdiDevice, XcdiDeviceOptions
from jointfit_simulators.sample._sample_captures import candump_text, natnet_pcap, xbus_bytes
from jointfit_simulators.scene import RigOptions, ids_toml, rig_toml
from jointfit_simulators.settings import Knobs

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_protocols.can import CanFrame
    from jointfit_simulators.devices import Pose, Vector
    from jointfit_simulators.imu_device import Quaternion

RATE_HZ = 50.0
"""Rate of sensors and cameras in the trials, Hz. It suffices for slow movements and yields small
files."""
CAPTURE_HZ = 100.0
"""Rate of sensors and cameras in the captures, Hz."""
CAPTURE_S = 2.0
"""Duration of the captures, s."""
APART_S = 200.0
"""Time between the starts of two trials, s. It is so long that the noise of the trials is
independent."""
TRIALS = {"standing": 5.0, "squats": 8.0, "walking": 8.0, "knee_swings": 8.0, "sit_to_stand": 8.0}
"""Duration of each trial, s, by name."""
_MOTIONS = {"standing": "stand", "squats": "squat", "walking": "walk"}
"""Names of motions that differ from the names of their trials."""
SWINGS_S = 10.0
"""Duration of the planar movement, s."""
_IDS = {
    "S2": XcdiIds(0x205, 0x206, 0x221, status_word=None, error=None),
    "S4": XcdiIds(0x405, 0x406, 0x421, status_word=None, error=None),
}
"""CAN identifiers of each sensor on the bus."""


class SampleTrial(NamedTuple):
    """Recorded data of one trial, z up."""

    t_s: Array
    sensors: Mapping[str, Array]
    """Orientations q_world_sensor by sensor, shape (n, 4)."""
    bones: Mapping[str, Array]
    """Orientations q_world_segment by segment, shape (n, 4)."""
    markers: tuple[str, ...]
    positions: Array
    """Marker positions, m, shape (n, len(markers), 3); NaN if occluded."""
    bodies: Mapping[str, tuple[Array, Array]]
    """Positions, m, shape (n, 3), and orientations q_world_body, shape (n, 4), of each rigid body.
    """


class FolderNotEmptyError(ValueError):
    """The output folder of the sample data is not empty."""


def write_sample(folder: Path, *, seed: int = 1, force: bool = False) -> dict[str, str]:
    """Write the sample data.

    Parameters
    ----------
    folder
        Output folder, which is created if necessary.
    seed
        Random seed of the simulated subject.
    force
        Whether to write into a folder that is not empty. Existing files of the same names are
        replaced.

    Returns
    -------
    dict
        Description of each file and of the commands that read it, by file name.

    Raises
    ------
    FolderNotEmptyError
        The folder is not empty, and `force` is not set.
    OSError
        The folder is not writable.
    """
    if folder.is_dir() and any(folder.iterdir()) and not force:
        message = f"{folder} is not empty: name a new folder, or use --force to replace files in it"
        raise FolderNotEmptyError(message)
    folder.mkdir(parents=True, exist_ok=True)

    knobs = dataclasses.replace(
        Knobs(seed=seed), heading_spread_deg=0.0, optical_heading_deg=0.0, mocap_hz=RATE_HZ
    )
    trials = {
        name: _record(knobs, _MOTIONS.get(name, name), APART_S * number, length_s, RATE_HZ)
        for number, (name, length_s) in enumerate(TRIALS.items())
    }
    standing = SimulatedSubject(knobs, [Step("stand", 1.0)])
    return (
        _write_marker_trials(folder, trials)
        | _write_planar_trial(folder, knobs)
        | _write_orientation_trials(folder, trials)
        | _write_models(folder, knobs, standing)
        | _write_captures(folder, knobs, standing)
        | _write_rig(folder, standing)
    )


def _record(
    knobs: Knobs, motion: str, start_s: float, length_s: float, rate_hz: float
) -> SampleTrial:
    subject = SimulatedSubject(knobs, [Step(motion, 1.0)], start_s=start_s)
    since_s = np.arange(round(length_s * rate_hz)) / rate_hz
    t_s = start_s + since_s
    observation = subject.observe([t_s] * len(subject.sensors), t_s, t_s)

    sensors = {
        name: OrientationSensor(knobs, name).report(t_s, q)
        for name, q in zip(subject.sensors, observation.sensors, strict=True)
    }
    truth = observation.truth.orientations
    bones = {part: to_wxyz(truth[part]) for part in ("thigh", "shank")}

    # The markers of the plate are the last ones. The trials do not contain the plate.
    names = tuple(name for part in PARTS for name in subject.clusters[part])
    cameras = Cameras(knobs, subject, rate_hz=rate_hz)
    frames = cameras.capture(observation)
    bodies = {
        body: (frames.body_positions[:, column], frames.body_orientations[:, column])
        for column, body in enumerate(cameras.bodies)
    }
    return SampleTrial(since_s, sensors, bones, names, frames.markers[:, : len(names)], bodies)


def _write_marker_trials(folder: Path, trials: Mapping[str, SampleTrial]) -> dict[str, str]:
    written = {}
    for name, trial in trials.items():
        y_up = trial.positions[..., [1, 2, 0]]  # OpenSim's axes: forward, up, right
        numbers = np.arange(1, len(trial.t_s) + 1)
        write_trc(
            folder / f"{name}.trc",
            MarkerTrajectories(trial.markers, trial.t_s, numbers, y_up, RATE_HZ),
        )
        written[f"{name}.trc"] = "markers, y up: jointfit center, markers, ik, fuse"

    squats = trials["squats"]
    y_up = squats.positions[..., [1, 2, 0]]
    (folder / "squats.c3d").write_bytes(c3d_bytes(squats.markers, y_up, rate_hz=RATE_HZ, up="+Y"))
    return written | {"squats.c3d": "the markers of squats.trc: jointfit center, fuse"}


def _write_planar_trial(folder: Path, knobs: Knobs) -> dict[str, str]:
    # Single markers at the ends of a chain determine its joints only without soft-tissue artefact.
    rigid = dataclasses.replace(knobs, marker_soft_tissue_mm=0.0)
    start_s = APART_S * (len(TRIALS) + 1)
    trial = _record(rigid, "leg_swings", start_s, SWINGS_S, RATE_HZ)
    numbers = np.arange(1, len(trial.t_s) + 1)
    y_up = trial.positions[..., [1, 2, 0]]
    write_trc(
        folder / "leg_swings.trc",
        MarkerTrajectories(trial.markers, trial.t_s, numbers, y_up, RATE_HZ),
    )
    return {
        "leg_swings.trc": "wide movement in a plane, markers rigid on the bones: jointfit center"
    }


def _write_orientation_trials(folder: Path, trials: Mapping[str, SampleTrial]) -> dict[str, str]:
    written = {}
    for name, trial in trials.items():
        write_orientations_npz(
            folder / f"{name}.npz", OrientationTrial(trial.t_s, trial.sensors, trial.bones, {})
        )
        written[f"{name}.npz"] = "sensors S1 to S4 and the bones: jointfit fuse"

    for name in ("standing", "walking"):
        sensors = trials[name].sensors
        table = OrientationTable(
            tuple(sensors), trials[name].t_s, np.stack(list(sensors.values()), axis=1), RATE_HZ
        )
        write_orientations_sto(folder / f"{name}.sto", table)
        written[f"{name}.sto"] = f"the sensors of {name}.npz, z up: jointfit fuse"
    return written


def _write_models(folder: Path, knobs: Knobs, subject: SimulatedSubject) -> dict[str, str]:
    parts = leg_parts(subject.geometry)
    markers = misplaced_markers(knobs.random("model"), subject.clusters, subject.templates, parts)
    (folder / "leg.toml").write_text(model_toml(parts, markers), encoding="utf-8")
    (folder / "leg.osim").write_text(model_osim(parts, markers), encoding="utf-8")
    return {
        "leg.toml": "a chain model with marker position errors of about 1 cm: jointfit markers, ik",
        "leg.osim": "the same model for OpenSim: jointfit markers, ik",
    }


def _write_captures(folder: Path, knobs: Knobs, subject: SimulatedSubject) -> dict[str, str]:
    trial = _record(knobs, "squat", APART_S * len(TRIALS), CAPTURE_S, CAPTURE_HZ)
    times_ns = [round(t_s * 1e9) for t_s in trial.t_s.tolist()]
    orientations = {
        name: [cast("Quaternion", tuple(q)) for q in sensor.tolist()]
        for name, sensor in trial.sensors.items()
    }

    samples = zip(times_ns, orientations["S1"], strict=True)
    (folder / "xbus.bin").write_bytes(xbus_bytes(samples))

    # The devices on the bus send at times that differ by 1 ms.
    devices = {
        name: XcdiDevice(_NoWire(), XcdiDeviceOptions(ids=ids)) for name, ids in _IDS.items()
    }
    groups = [
        (t_ns + place * 1_000_000, device.group(t_ns, orientations[name][index]))
        for index, t_ns in enumerate(times_ns)
        for place, (name, device) in enumerate(devices.items())
    ]
    (folder / "can.log").write_text(candump_text(groups, "can0"), "utf-8")

    frames = [
        (t_ns, _markers(trial, index), _bodies(trial, index)) for index, t_ns in enumerate(times_ns)
    ]
    clusters = {part: subject.clusters[part] for part in PARTS}
    (folder / "cameras.pcap").write_bytes(natnet_pcap(clusters, frames, CAPTURE_HZ))
    return {
        "xbus.bin": "sensor S1 on its UART: jointfit decode xbus",
        "can.log": "sensors S2 and S4 on CAN, in the format of candump -L: jointfit decode xcdi",
        "cameras.pcap": "the datagrams of the cameras: jointfit decode natnet",
    }


def _markers(trial: SampleTrial, index: int) -> dict[str, Vector | None]:
    positions = trial.positions[index].tolist()
    return {
        name: None if np.isnan(at[0]) else cast("Vector", tuple(at))
        for name, at in zip(trial.markers, positions, strict=True)
    }


def _bodies(trial: SampleTrial, index: int) -> dict[str, Pose | None]:
    poses = ((name, p[index].tolist(), q[index].tolist()) for name, (p, q) in trial.bodies.items())
    return {
        name: None if np.isnan(p[0]) else cast("Pose", (tuple(p), tuple(q))) for name, p, q in poses
    }


class _NoWire:
    """Closed bus, for a device whose frames are returned instead of sent."""

    bitrate: int | None = None
    is_open = False

    def send(self, frames: Iterable[CanFrame]) -> bool:  # noqa: ARG002 - as CanWire
        return False

    async def run(self) -> None: ...

    def unplug(self) -> None: ...

    def plug(self) -> None: ...


def _write_rig(folder: Path, subject: SimulatedSubject) -> dict[str, str]:
    devices = []
    for name, segment in subject.sensors.items():
        lines = ["[[imu]]", f'id = "{name}"', f'segment = "{segment}"']
        if name in _IDS:
            lines += ['driver = "xcdi"', 'can = "can0"', ids_toml(_IDS[name])]
        else:
            lines += ['driver = "xbus"', f'port = "/dev/jointfit/imu-{name}"', "baud = 921600"]
        devices.append("\n".join([*lines, "rate_hz = 100", ""]))
    devices.append('[can.can0]\ninterface = "socketcan"\nchannel = "can0"\n')

    text = rig_toml(
        RigOptions(name="sample", mqtt_base="jointfit/sample", store="sample"),
        devices=devices,
        mocap='[mocap]\ndriver = "natnet"\nserver = "192.168.1.10"\nup_axis = "y"',
        clusters=subject.clusters,
        bones=(),
        plate=True,
    )
    (folder / "rig.toml").write_text(text, encoding="utf-8")
    return {"rig.toml": "a rig of four sensors and cameras: jointfit check, jointfitd"}
