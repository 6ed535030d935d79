"""Simulated subject with bones, soft-tissue artefacts, sensors and markers, in the base world.

The *base world* is the world in which the movement of the subject is described, with z up.

Invariant: observations depend only on the time, the settings and the sequence of motions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_simulators.body._limb import (
    ON_PLATE,
    PLATE_POSITION,
    PLATE_TURN,
    LegGeometry,
    LegPose,
    included_angle,
)
from jointfit_simulators.body._limb_kinds import LIMBS, leg
from jointfit_simulators.body._motion import motions_of
from jointfit_simulators.body._motion_file import motion_from_file
from jointfit_simulators.body._motion_script import MotionScript, Step
from jointfit_simulators.body._orientation import Rotation, to_wxyz
from jointfit_simulators.body._placement import PLATE_TEMPLATE, random_misalignment
from jointfit_simulators.body._posture import draw_style
from jointfit_simulators.body._soft_tissue import SoftTissue
from jointfit_simulators.body._subject import GroundTruth, Observation

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body._limb_kind import RigChain
    from jointfit_simulators.settings import Knobs


class SimulatedSubject:
    """Limb that performs a sequence of motions.

    Parameters
    ----------
    knobs
        Sensor alignment, soft-tissue artefact and random seed.
    steps
        Sequence of motions, which begins at `start_s`.
    geometry
        Bone lengths and joint centres of the leg.
    motion_files
        Additional motions by name (`motion_from_file`).
    sensors
        Segment of each sensor, by sensor id. The default is the usual sensors of the limb.
    limb
        ``leg``, ``legs``, ``arm`` or ``trunk``.
    """

    visible_bones: tuple[str, ...] = ()
    """Bones that the cameras stream. The tuple is empty, because the cameras measure markers only.
    """

    def __init__(
        self,
        knobs: Knobs,
        steps: Iterable[Step],
        *,
        start_s: float = 0.0,
        geometry: LegGeometry | None = None,
        motion_files: Mapping[str, Path] | None = None,
        sensors: Mapping[str, str] | None = None,
        limb: str = "leg",
    ) -> None:
        self.geometry = geometry or LegGeometry()
        self._limb = leg(self.geometry) if limb == "leg" else LIMBS[limb]
        self.sensors = sensors or self._limb.sensors
        self.clusters = self._limb.clusters
        style = draw_style(self.geometry, knobs.random("style"))
        motions = motions_of(style, self._limb.motions)
        for name, path in (motion_files or {}).items():
            motions[name] = motion_from_file(path, style)
        self._script = MotionScript(
            motions, steps, start_s=start_s, transition_s=knobs.transition_s
        )

        # The RMS values of the settings are valid for one minute of these motions (for a leg:
        # walking and squats).
        t_s = np.arange(0.0, 30.0, 0.04)
        reference = np.concatenate([motions[name](t_s) for name in self._limb.reference])
        self._place_sensors(knobs, reference)
        self._place_markers(knobs, reference)

    def _place_sensors(self, knobs: Knobs, reference: Array) -> None:
        common = np.radians(knobs.soft_tissue_common_deg)
        single = np.radians(knobs.soft_tissue_sensor_deg)
        parts = sorted(set(self.sensors.values()))
        self._common = {
            part: self._soft_tissue(knobs, reference, "soft tissue", part, common) for part in parts
        }
        self._single = {
            sensor: self._soft_tissue(knobs, reference, f"soft tissue {sensor}", part, single)
            for sensor, part in self.sensors.items()
        }

        most_rad = np.radians(knobs.mount_deg)
        self._mounts, self._plate_mounts = (
            {
                sensor: random_misalignment(knobs.random(f"{place} {sensor}"), most_rad)
                for sensor in self.sensors
            }
            for place in ("mount", "plate mount")
        )

    def _place_markers(self, knobs: Knobs, reference: Array) -> None:
        templates = self._limb.templates(knobs.random("markers"))
        self.templates = {**templates, "plate": PLATE_TEMPLATE}
        self._marker_artefacts = {
            part: self._soft_tissue(
                knobs,
                reference,
                "markers",
                part,
                knobs.marker_soft_tissue_mm / 1e3,
                vectors=len(self.clusters[part]),
                common_share=knobs.marker_common_share,
            )
            for part in self._limb.adjacent
        }

    def _soft_tissue(
        self,
        knobs: Knobs,
        reference: Array,
        purpose: str,
        part: str,
        rms: float,
        *,
        vectors: int = 1,
        common_share: float = 0.0,
    ) -> SoftTissue:
        """Return the artefact of `vectors` points on `part`; `rms` is in m or rad."""
        return SoftTissue(
            knobs.random(f"{purpose} {part}"),
            part,
            vectors,
            rms=rms,
            random_share=knobs.soft_tissue_random_share,
            knee_share=knobs.soft_tissue_knee_share,
            reference=reference,
            common_share=common_share,
            adjacent=self._limb.adjacent,
        )

    @property
    def chain(self) -> RigChain:
        """Description of the limb in rig.toml."""
        return self._limb.chain

    @property
    def facts(self) -> Mapping[str, object]:
        """Geometry and sensor alignment, for the ground-truth log."""
        return {
            **self._limb.facts,
            "joint": self._limb.main.name,
            "q_segment_sensor": {s: to_wxyz(m).tolist() for s, m in self._mounts.items()},
            "q_plate_sensor": {s: to_wxyz(m).tolist() for s, m in self._plate_mounts.items()},
            "markers_m": {part: points.tolist() for part, points in self.templates.items()},
        }

    def play(self, name: str, t_s: float, *, at_once: bool = False) -> None:
        """Start another motion; raise UnknownMotionError for an unknown name."""
        self._script.play(name, t_s, at_once=at_once)

    def motion_at(self, t_s: float) -> str:
        """Return the name of the motion at the time `t_s`."""
        return self._script.name_at(t_s)

    def discard_before(self, t_s: float) -> None:
        """Discard the state for times before `t_s`, which will not be requested again."""
        self._script.discard_before(t_s)

    def observe(self, sensors: Sequence[Array], cameras: Array, truth: Array) -> Observation:
        """Return the observation at the given times (s) of each sensor, the cameras and the log."""
        # Compute the postures of all streams together, then divide them by stream.
        streams = [*sensors, cameras, truth]
        t_s = np.concatenate(streams)
        coordinates = self._script.coordinates(t_s)
        pose = self._limb.pose(coordinates)
        ends = np.cumsum([len(stream) for stream in streams])
        cuts = [slice(end - len(stream), end) for stream, end in zip(streams, ends, strict=True)]

        orientations = [
            self._sensor(sensor, t_s[cut], coordinates[cut], pose.orientations[part][cut])
            for (sensor, part), cut in zip(self.sensors.items(), cuts, strict=False)
        ]
        cut = cuts[-2]
        markers = self._markers(t_s[cut], coordinates[cut], _part_of(pose, cut))
        cut = cuts[-1]
        bones = _part_of(pose, cut)
        main = self._limb.main
        ground_truth = GroundTruth(
            bones.orientations,
            {joint: bones.origins[part] for joint, part in self._limb.joints.items()},
            coordinates[cut][:, main.columns],
            included_angle(bones.orientations[main.proximal], bones.orientations[main.distal]),
            main.name,
        )
        return Observation(orientations, markers, {}, ground_truth)

    def _sensor(self, sensor: str, t_s: Array, coordinates: Array, bone: Rotation) -> Array:
        if not len(t_s):
            return np.empty((0, 4))
        common = self._common[self.sensors[sensor]].at(t_s, coordinates)[:, 0]
        single = self._single[sensor].at(t_s, coordinates)[:, 0]
        on_leg = bone * Rotation.from_rotvec(common) * Rotation.from_rotvec(single)
        on_leg *= self._mounts[sensor]
        share = coordinates[:, ON_PLATE, None]
        if not np.any(share):
            return to_wxyz(on_leg)

        # Move the sensor orientation from the leg to the plate along the shortest arc.
        on_plate = Rotation.from_rotvec(coordinates[:, PLATE_TURN]) * self._plate_mounts[sensor]
        arc = (on_leg.inv() * on_plate).as_rotvec() * share
        return to_wxyz(on_leg * Rotation.from_rotvec(arc))

    def _markers(self, t_s: Array, coordinates: Array, pose: LegPose) -> Array:
        if not len(t_s):
            return np.empty((0, sum(map(len, self.clusters.values())), 3))
        markers = [
            _to_world(
                pose.orientations[part],
                pose.origins[part],
                self.templates[part] + self._marker_artefacts[part].at(t_s, coordinates),
            )
            for part in self._limb.adjacent
        ]

        plate = Rotation.from_rotvec(coordinates[:, PLATE_TURN])
        template = np.broadcast_to(PLATE_TEMPLATE, (len(t_s), *PLATE_TEMPLATE.shape))
        markers.append(_to_world(plate, coordinates[:, PLATE_POSITION], template))
        return np.concatenate(markers, axis=1)


def _to_world(turn: Rotation, origin: Array, points: Array) -> Array:
    """Return world coordinates of points in the frame of a body, shape (n, k, 3)."""
    turned: Array = np.einsum("nij,nkj->nki", turn.as_matrix(), points)
    return turned + origin[:, None, :]


def _part_of(pose: LegPose, cut: slice) -> LegPose:
    """Return the pose at a part of its times."""
    return LegPose(
        {part: turn[cut] for part, turn in pose.orientations.items()},
        {part: origin[cut] for part, origin in pose.origins.items()},
    )
