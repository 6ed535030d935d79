"""Simulated subject: bones, soft-tissue artefacts, sensors and markers, in the base world.

Invariant: observations depend only on time, the settings and the sequence of motions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_simulators.body._limb import (
    KNEE,
    ON_PLATE,
    PARTS,
    PLATE_POSITION,
    PLATE_TURN,
    LegGeometry,
    included_angle,
    leg_pose,
)
from jointfit_simulators.body._motion import motions_of
from jointfit_simulators.body._motion_file import motion_from_file
from jointfit_simulators.body._motion_script import MotionScript, Step
from jointfit_simulators.body._orientation import Rotation, to_wxyz
from jointfit_simulators.body._placement import (
    CLUSTERS,
    marker_templates,
    plate_template,
    random_misalignment,
)
from jointfit_simulators.body._posture import draw_style
from jointfit_simulators.body._soft_tissue import SoftTissue
from jointfit_simulators.body._subject import GroundTruth, Observation

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from jointfit_simulators.body._limb import LegPose
    from jointfit_simulators.body._motion import Motion
    from jointfit_simulators.settings import Knobs

SENSORS = {"S1": "thigh", "S2": "thigh", "S3": "shank", "S4": "shank"}


def walking_and_squats(motions: Mapping[str, Motion]) -> NDArray[np.float64]:
    """Return coordinates of a minute of walking and squats: what soft-tissue knobs refer to."""
    t_s = np.arange(0.0, 30.0, 0.04)
    return np.concatenate([motions["walk"](t_s), motions["squat"](t_s)])


@dataclass(frozen=True)
class _Person:
    """Makes the skin of one person."""

    knobs: Knobs
    reference: NDArray[np.float64]

    def skin(
        self, purpose: str, part: str, rms: float, *, vectors: int = 1, common_share: float = 0.0
    ) -> SoftTissue:
        """Return skin that moves `vectors` points on `part` by `rms`, m or rad."""
        return SoftTissue(
            self.knobs.random(f"{purpose} {part}"),
            part,
            vectors,
            rms=rms,
            random_share=self.knobs.soft_tissue_random_share,
            knee_share=self.knobs.soft_tissue_knee_share,
            reference=self.reference,
            common_share=common_share,
        )


class SimulatedSubject:
    """A right leg that follows a programme.

    Parameters
    ----------
    knobs
        Mounts, soft tissue and dice.
    steps
        What is done from `start_s` on.
    geometry
        The bones.
    motion_files
        Further motions by name (`motion_file`).
    sensors
        Sensor ids and the segment each is worn on.
    """

    visible_bones: tuple[str, ...] = ()
    """None: nobody sees this person's bones."""

    def __init__(
        self,
        knobs: Knobs,
        steps: Iterable[Step],
        *,
        start_s: float = 0.0,
        geometry: LegGeometry | None = None,
        motion_files: Mapping[str, Path] | None = None,
        sensors: Mapping[str, str] | None = None,
    ) -> None:
        self.geometry = geometry or LegGeometry()
        self.sensors = sensors or SENSORS
        self.clusters = CLUSTERS
        style = draw_style(self.geometry, knobs.random("style"))
        motions = motions_of(style)
        for name, path in (motion_files or {}).items():
            motions[name] = motion_from_file(path, style)
        self._programme = MotionScript(
            motions, steps, start_s=start_s, transition_s=knobs.transition_s
        )
        body = _Person(knobs, walking_and_squats(motions))
        self._place_sensors(knobs, body)
        self._place_markers(knobs, body)

    def _place_sensors(self, knobs: Knobs, body: _Person) -> None:
        common = np.radians(knobs.soft_tissue_common_deg)
        own = np.radians(knobs.soft_tissue_sensor_deg)
        parts = sorted(set(self.sensors.values()))
        self._common = {part: body.skin("soft tissue", part, common) for part in parts}
        self._own = {
            sensor: body.skin(f"soft tissue {sensor}", part, own)
            for sensor, part in self.sensors.items()
        }
        self._mounts = {
            sensor: random_misalignment(
                knobs.random(f"mount {sensor}"), np.radians(knobs.mount_deg)
            )
            for sensor in self.sensors
        }
        self._plate_mounts = {
            sensor: random_misalignment(
                knobs.random(f"plate mount {sensor}"), np.radians(knobs.mount_deg)
            )
            for sensor in self.sensors
        }

    def _place_markers(self, knobs: Knobs, body: _Person) -> None:
        self._templates = marker_templates(knobs.random("markers"), self.geometry)
        self.templates = {**self._templates, "plate": plate_template()}
        self._marker_skin = {
            part: body.skin(
                "markers",
                part,
                knobs.marker_soft_tissue_mm / 1e3,
                vectors=len(CLUSTERS[part]),
                common_share=knobs.marker_common_share,
            )
            for part in PARTS
        }

    @property
    def facts(self) -> Mapping[str, object]:
        """Geometry and mounts, for the truth log."""
        return {
            "lengths_m": {"thigh": self.geometry.thigh_m, "shank": self.geometry.shank_m},
            "joint_centers_m": {  # each in the frame of the part proximal to it
                "hip_in_pelvis": list(self.geometry.hip_in_pelvis),
                "knee_in_thigh": [0.0, 0.0, -self.geometry.thigh_m],
                "ankle_in_shank": [0.0, 0.0, -self.geometry.shank_m],
            },
            "q_segment_sensor": {s: to_wxyz(m).tolist() for s, m in self._mounts.items()},
            "q_plate_sensor": {s: to_wxyz(m).tolist() for s, m in self._plate_mounts.items()},
            "markers_m": {part: found.tolist() for part, found in self.templates.items()},
        }

    def play(self, name: str, t_s: float) -> None:
        """Begin another motion; UnknownMotion if there is none of that name."""
        self._programme.play(name, t_s)

    def motion_at(self, t_s: float) -> str:
        """Return the name of the motion at an instant."""
        return self._programme.name_at(t_s)

    def discard_before(self, t_s: float) -> None:
        """Promise never to ask about earlier instants again."""
        self._programme.discard_before(t_s)

    def observe(
        self,
        sensors: Sequence[NDArray[np.float64]],
        cameras: NDArray[np.float64],
        truth: NDArray[np.float64],
    ) -> Observation:
        """Return what is to be seen; the posture is worked out once for all streams."""
        streams = [*sensors, cameras, truth]
        t_s = np.concatenate(streams)
        coordinates = self._programme.coordinates(t_s)
        pose = leg_pose(self.geometry, coordinates)
        ends = np.cumsum([len(stream) for stream in streams])
        cuts = [slice(end - len(stream), end) for stream, end in zip(streams, ends, strict=True)]
        seen = [
            self._sensor(sensor, t_s[cut], coordinates[cut], pose.orientations[part][cut])
            for (sensor, part), cut in zip(self.sensors.items(), cuts, strict=False)
        ]
        markers = self._markers(t_s[cuts[-2]], coordinates[cuts[-2]], _cut(pose, cuts[-2]))
        return Observation(seen, markers, {}, _truth(coordinates[cuts[-1]], _cut(pose, cuts[-1])))

    def _sensor(
        self,
        sensor: str,
        t_s: NDArray[np.float64],
        coordinates: NDArray[np.float64],
        bone: Rotation,
    ) -> NDArray[np.float64]:
        if not len(t_s):
            return np.empty((0, 4))
        common = self._common[self.sensors[sensor]].at(t_s, coordinates)[:, 0]
        own = self._own[sensor].at(t_s, coordinates)[:, 0]
        worn = bone * Rotation.from_rotvec(common) * Rotation.from_rotvec(own)
        worn *= self._mounts[sensor]
        share = coordinates[:, ON_PLATE, None]
        if not np.any(share):
            return to_wxyz(worn)
        held = Rotation.from_rotvec(coordinates[:, PLATE_TURN]) * self._plate_mounts[sensor]
        carried = (worn.inv() * held).as_rotvec() * share
        return to_wxyz(worn * Rotation.from_rotvec(carried))

    def _markers(
        self, t_s: NDArray[np.float64], coordinates: NDArray[np.float64], pose: LegPose
    ) -> NDArray[np.float64]:
        if not len(t_s):
            return np.empty((0, sum(map(len, CLUSTERS.values())), 3))
        found = [
            _carried(
                pose.orientations[part],
                pose.origins[part],
                self._templates[part] + self._marker_skin[part].at(t_s, coordinates),
            )
            for part in PARTS
        ]
        plate = Rotation.from_rotvec(coordinates[:, PLATE_TURN])
        template = np.broadcast_to(
            self.templates["plate"], (len(t_s), *self.templates["plate"].shape)
        )
        found.append(_carried(plate, coordinates[:, PLATE_POSITION], template))
        return np.concatenate(found, axis=1)


def _carried(
    turn: Rotation, origin: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return points of a body, shape (n, k, 3), in the world."""
    turned: NDArray[np.float64] = np.einsum("nij,nkj->nki", turn.as_matrix(), points)
    return turned + origin[:, None, :]


def _cut(pose: LegPose, cut: slice) -> LegPose:
    return type(pose)(
        {part: turn[cut] for part, turn in pose.orientations.items()},
        {part: origin[cut] for part, origin in pose.origins.items()},
    )


def _truth(coordinates: NDArray[np.float64], pose: LegPose) -> GroundTruth:
    thigh, shank = pose.orientations["thigh"], pose.orientations["shank"]
    joints = {"hip": pose.origins["thigh"], "knee": pose.origins["shank"]}
    return GroundTruth(
        pose.orientations,
        {**joints, "ankle": pose.origins["foot"]},
        coordinates[:, KNEE],
        included_angle(thigh, shank),
    )
