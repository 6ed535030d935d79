"""Recorded walk with Xsens sensors on pelvis and legs, with the model of OpenSim's example.

The sensors are calibrated for OpenSim and for this project in the same way: the subject stands in
the first frame in the neutral pose of the model, and faces the direction of the z axis of the
sensor on the pelvis.
"""

from __future__ import annotations

import functools
import math
import os
import re
import shutil
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.subjects.opensim_reference import without_forces
from jointfit_daemon.config import parse_rig
from jointfit_daemon.files.sessions import read_session, write_session
from jointfit_daemon.kinematics.rotation_scalar import conjugate_one, multiply_one, rotate_one
from jointfit_daemon.limb_model import (
    Calibration,
    JointCalibration,
    SegmentCalibration,
    SensorCalibration,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.config import Rig
    from jointfit_daemon.model import Quaternion
    from jointfit_daemon.session_data import SessionData

FOLDER = "opensense_xsens"
RATE_HZ = 100
SEGMENTS = {
    "pelvis": "pelvis",
    "femur_r": "right_thigh", "tibia_r": "right_shank", "calcn_r": "right_foot",
    "femur_l": "left_thigh", "tibia_l": "left_shank", "calcn_l": "left_foot",
}  # fmt: skip
"""Segments by body of the model; the sensor of a body has the name of the body."""
COORDINATES = {
    "right_hip": "hip_flexion_r", "right_knee": "knee_angle_r",
    "left_hip": "hip_flexion_l", "left_knee": "knee_angle_l",
}  # fmt: skip
"""Coordinates of the model that correspond to the flexion of a joint."""
_TRACKED = re.compile(r"pelvis_(tilt|list|rotation)|hip_|knee_|ankle_")
"""Coordinates that orientations of pelvis and legs determine; the others are locked."""
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Walk:
    """Orientations of the sensors, q_world_sensor, in every frame."""

    session: SessionData
    names: dict[str, str]
    """Body of the model by identifier of the sensor."""
    frames: list[dict[str, Quaternion]]


def read_walk(data: Path) -> Walk:
    """Return the frames that all sensors have."""
    folder = data / FOLDER
    text = (folder / "myIMUMappings.xml").read_text(encoding="utf-8")
    found = re.findall(r'name="_(\w+)">.*?<name_in_model>(\w+)_imu<', text, re.DOTALL)
    session = read_session(folder / "IMUData")
    names = dict(found)
    numbers = [np.rint(sensor.t_s * RATE_HZ).astype(int) for sensor in session.sensors]
    common = functools.reduce(np.intersect1d, numbers)
    tracks = {}
    for sensor, number in zip(session.sensors, numbers, strict=True):
        assert sensor.orientation is not None
        tracks[names[sensor.id]] = sensor.orientation[np.isin(number, common)].tolist()
    frames = [{body: tuple(tracks[body][k]) for body in SEGMENTS} for k in range(len(common))]
    return Walk(session, names, frames)


def legs_rig() -> Rig:
    """Return the rig of pelvis and legs, with ports that are never opened."""
    joints: list[dict[str, str]] = []
    for side in ("right", "left"):
        parts = ["pelvis", *(f"{side}_{part}" for part in ("thigh", "shank", "foot"))]
        for joint, parent, child in zip(("hip", "knee", "ankle"), parts, parts[1:], strict=False):
            joints.append({"name": f"{side}_{joint}", "parent": parent, "child": child})
        joints.append({"name": f"{side}_toe", "parent": parts[-1]})
        joints[-4]["side"] = side
    imu = {"driver": "xbus", "baud": 921_600, "rate_hz": RATE_HZ}
    return parse_rig(
        {
            "rig": {"name": "walk", "output_rate_hz": RATE_HZ},
            "chain": {"segments": list(SEGMENTS.values()), "joint": joints},
            "imu": [
                imu | {"id": body, "segment": segment, "port": f"/dev/{body}"}
                for body, segment in SEGMENTS.items()
            ],
        }
    )


def standing_calibration(rig: Rig, first: dict[str, Quaternion]) -> Calibration:
    """Return the calibration of the neutral pose in the first frame.

    A rotation about the vertical turns the z axis of the sensor on the pelvis forward (y).
    """
    east, north, _ = rotate_one(first["pelvis"], (0.0, 0.0, 1.0))
    half = 0.5 * (0.5 * math.pi - math.atan2(north, east))
    facing = (math.cos(half), 0.0, 0.0, math.sin(half))
    chain = rig.chain
    return Calibration(
        method="mean",
        joints=chain.joints,
        segments=chain.segments,
        chain_sensors=chain.sensors,
        parents=chain.parents,
        left_joints=chain.left_joints,
        sensor={
            body: SensorCalibration(facing, conjugate_one(multiply_one(facing, q)))
            for body, q in first.items()
        },
        segment={name: SegmentCalibration(UPRIGHT, None, None) for name in chain.segments},
        joint={name: JointCalibration(None, None, "unknown") for name in chain.joints},
    )


class OpenSimTracker:
    """OpenSim's inverse kinematics of orientations, frame after frame.

    OpenSenseRT calls the same solver for each sample. Forces are removed, and coordinates that the
    sensors do not determine are locked, because both would only cost time.
    """

    def __init__(self, walk: Walk, data: Path, folder: Path) -> None:
        import opensim  # noqa: PLC0415 - optional, and slow to import

        opensim.Logger.setLevelString("off")
        names = {number: f"{body}_imu" for number, body in walk.names.items()}
        written = write_session(walk.session, folder, "sto", names=names).files[0]
        orientations = folder / "orientations.sto"
        shutil.move(written, orientations)
        self._model = self._placed(opensim, data, folder, orientations)

        table = opensim.TimeSeriesTableQuaternion(os.fspath(orientations))
        for column in set(table.getColumnLabels()) - {f"{body}_imu" for body in SEGMENTS}:
            table.removeColumn(column)
        upward = opensim.Rotation()
        upward.setRotationFromAngleAboutX(-0.5 * math.pi)  # z up to y up
        opensim.OpenSenseUtilities.rotateOrientationTable(table, upward)
        rotations = opensim.OpenSenseUtilities.convertQuaternionsToRotations(table)
        self.t_s = list(rotations.getIndependentColumn())

        self._state = self._model.initSystem()
        # The solver keeps no reference of its own to its inputs.
        self._inputs: tuple[Any, ...] = (
            opensim.MarkersReference(),
            opensim.OrientationsReference(rotations),
            opensim.SimTKArrayCoordinateReference(),
        )
        self._solver = opensim.InverseKinematicsSolver(self._model, *self._inputs)
        found = self._model.getCoordinateSet()
        self._coordinates = [found.get(name) for name in COORDINATES.values()]

    def _placed(self, opensim: Any, data: Path, folder: Path, orientations: Path) -> Any:
        """Return the model with the sensors placed by IMUPlacer."""
        bare, placed = folder / "bare.osim", folder / "placed.osim"
        model = without_forces(data / FOLDER / "Rajagopal_2015.osim")
        model.finalizeConnections()
        model.printToXML(os.fspath(bare))
        placer = opensim.IMUPlacer()
        placer.set_model_file(os.fspath(bare))
        placer.set_base_imu_label("pelvis_imu")
        placer.set_base_heading_axis("z")
        placer.set_sensor_to_opensim_rotations(opensim.Vec3(-0.5 * math.pi, 0, 0))
        placer.set_orientation_file_for_calibration(os.fspath(orientations))
        placer.set_output_model_file(os.fspath(placed))
        placer.run(False)
        model = opensim.Model(os.fspath(placed))
        for coordinate in model.updCoordinateSet():
            if not _TRACKED.match(coordinate.getName()):
                coordinate.set_locked(True)
        return model

    def begin(self, number: int) -> None:
        """Solve for the pose of a frame, starting from the neutral pose."""
        self._state.setTime(self.t_s[number])
        self._solver.assemble(self._state)

    def track(self, number: int) -> list[float]:
        """Return the flexion angles of a frame, rad; the solver starts from the previous frame."""
        self._state.setTime(self.t_s[number])
        self._solver.track(self._state)
        return [coordinate.getValue(self._state) for coordinate in self._coordinates]
