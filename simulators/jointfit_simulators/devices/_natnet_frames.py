"""Rigid bodies of a simulated NatNet server, and conversion of poses to its frames.

Input poses are in a world with z up. Frames have the axes of the server.

Invariant: an untracked body repeats its last valid pose, with bit 0 of its flags clear. An occluded
labeled marker is omitted, or has bit 0 of its flags set and a plausible position.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

from jointfit_protocols.natnet import (
    BODY_TRACKED,
    MARKER_HAS_MODEL,
    MARKER_OCCLUDED,
    MARKER_POINT_CLOUD_SOLVED,
    NAMES_FROM,
    Body,
    BodyDescription,
    FrameOfData,
    LabeledMarker,
    MarkerSet,
    MarkerSetDescription,
    ModelDefinition,
    Version,
)

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Pose = tuple[Vector, Quaternion]
Markers = Mapping[str, Vector | None]
Bodies = Mapping[str, Pose | None]
Axis = Literal["x", "y", "z"]
Hiding = Literal["missing", "filled"]

_VISIBLE = MARKER_POINT_CLOUD_SOLVED | MARKER_HAS_MODEL
_FILLED = _VISIBLE | MARKER_OCCLUDED
_SIZE, _RESIDUAL, _ERROR = 0.02, 2e-4, 2e-4
"""Marker diameter, marker residual and mean marker error of a body, m."""
_OFFSET_FROM: Version = (4, 2)
"""First bitstream version in which a body description contains an offset quaternion."""
_ORIGIN: Vector = (0.0, 0.0, 0.0)
_NEVER_TRACKED: Pose = (_ORIGIN, (1.0, 0.0, 0.0, 0.0))

_HALF = math.sqrt(0.5)
_AXES: dict[Axis, tuple[Callable[..., Vector], Callable[..., Quaternion]]] = {
    "x": (
        lambda x, y, z: (z, y, -x),
        lambda w, x, y, z: (_HALF * (w - y), _HALF * (x + z), _HALF * (y + w), _HALF * (z - x)),
    ),
    "y": (
        lambda x, y, z: (x, z, -y),
        lambda w, x, y, z: (_HALF * (w + x), _HALF * (x - w), _HALF * (y + z), _HALF * (z - y)),
    ),
    "z": (lambda x, y, z: (x, y, z), lambda w, x, y, z: (w, x, y, z)),
}
"""Conversion of vectors and of quaternions (w, x, y, z) from z up to the server's up axis."""


@dataclass(frozen=True, slots=True)
class RigidBodyAsset:
    """Rigid body of a Motive project, with the names of its markers."""

    name: str
    markers: tuple[str, ...]
    id: int
    """Streaming id of the body in Motive."""
    positions: tuple[Vector, ...] = ()
    """Marker positions in the body frame for the model description, m; zeros if empty."""


@dataclass(frozen=True, slots=True)
class FrameStamps:
    """Number, times and flags of one frame. Times are server ticks, but `timestamp` is in s."""

    number: int
    timestamp: float
    exposure: int
    received: int
    transmit: int
    params: int


def axes_from_z_up(up_axis: Axis) -> tuple[Callable[..., Vector], Callable[..., Quaternion]]:
    """Return the conversion of positions and orientations from z up to a server's up axis."""
    return _AXES[up_axis]


def model_definition(bodies: tuple[RigidBodyAsset, ...], version: Version) -> ModelDefinition:
    """Return the descriptions of `bodies`, in the order of Motive.

    Parameters
    ----------
    bodies : tuple of RigidBodyAsset
        Rigid bodies of the project.
    version : (int, int)
        Bitstream version. From 4.0, a body contains the names of its markers. From 4.2, it contains
        the offset quaternion that the only known client for 4.2 expects.
    """
    # The set of all markers follows the marker sets of the bodies.
    every = tuple(f"{body.name}_{i}" for body in bodies for i in range(1, len(body.markers) + 1))
    sets = [MarkerSetDescription(body.name, body.markers) for body in bodies]
    described = [
        BodyDescription(
            body.name,
            body.id,
            positions=body.positions or (_ORIGIN,) * len(body.markers),
            labels=(0,) * len(body.markers),
            markers=body.markers if version >= NAMES_FROM else (),
            rotation=(0.0, 0.0, 0.0, 1.0) if version >= _OFFSET_FROM else None,
        )
        for body in bodies
    ]
    return ModelDefinition((*described, *sets, MarkerSetDescription("all", every)))


class NatNetFrameBuilder:
    """Converts poses to frames; stores the last valid pose of each marker and body."""

    def __init__(self, bodies: tuple[RigidBodyAsset, ...], up_axis: Axis, hiding: Hiding) -> None:
        self.bodies = bodies
        self._filled = hiding == "filled"
        self._place, self._turn = axes_from_z_up(up_axis)
        self._poses: dict[str, Pose] = {}
        self._markers: dict[str, Vector] = {}

    def frame(self, stamps: FrameStamps, markers: Markers, bodies: Bodies) -> FrameOfData:
        """Return one frame.

        Parameters
        ----------
        stamps : FrameStamps
            Frame number and times.
        markers : mapping of str to (x, y, z) or None
            Position in the world (z up), m; None if occluded. Markers without a body are sent as
            unlabeled.
        bodies : mapping of str to pose or None
            Position in the world (z up), m, and q_world_body (w, x, y, z); None if untracked.
        """
        self._markers |= {name: self._place(*at) for name, at in markers.items() if at is not None}
        self._poses |= {
            name: (self._place(*pose[0]), self._turn(*pose[1]))
            for name, pose in bodies.items()
            if pose is not None
        }

        sets = [self._marker_set(body, markers) for body in self.bodies]
        every = MarkerSet("all", tuple(at for one in sets for at in one.positions))
        owned = {name for body in self.bodies for name in body.markers}
        loose = [name for name, at in markers.items() if at is not None and name not in owned]
        return FrameOfData(
            stamps.number,
            stamps.timestamp,
            stamps.exposure,
            stamps.received,
            stamps.transmit,
            stamps.params,
            bodies=tuple(self._body(body, bodies.get(body.name)) for body in self.bodies),
            markers=tuple(m for body in self.bodies for m in self._labeled_markers(body, markers)),
            marker_sets=(*sets, every),
            other_markers=tuple(self._markers[name] for name in loose),
        )

    def _body(self, body: RigidBodyAsset, pose: Pose | None) -> Body:
        (x, y, z), (w, i, j, k) = self._poses.get(body.name, _NEVER_TRACKED)
        params = 0 if pose is None else BODY_TRACKED
        return Body(body.id, x, y, z, i, j, k, w, _ERROR, params)

    def _marker_set(self, body: RigidBodyAsset, markers: Markers) -> MarkerSet:
        shown = [name for name in body.markers if self._filled or markers.get(name) is not None]
        last = {name: self._markers[name] for name in shown if name in self._markers}
        return MarkerSet(body.name, tuple(last.get(name, _ORIGIN) for name in body.markers))

    def _labeled_markers(self, body: RigidBodyAsset, markers: Markers) -> list[LabeledMarker]:
        labeled = []
        for member, name in enumerate(body.markers, 1):
            visible = markers.get(name) is not None
            if visible or (self._filled and name in self._markers):
                x, y, z = self._markers[name]
                params = _VISIBLE if visible else _FILLED
                labeled.append(
                    LabeledMarker(body.id << 16 | member, x, y, z, _SIZE, params, _RESIDUAL)
                )
        return labeled
