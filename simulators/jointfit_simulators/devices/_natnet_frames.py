"""Rigid bodies of a simulated NatNet server, and conversion of poses to its frames.

Input poses are z up; frames have the server's own axes.

Invariant: an untracked body repeats its last valid pose with bit 0 clear. An occluded labeled
marker is omitted, or has bit 0 set and a plausible position.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
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

_HALF = math.sqrt(0.5)
_SEEN = MARKER_POINT_CLOUD_SOLVED | MARKER_HAS_MODEL
_FILLED = _SEEN | MARKER_OCCLUDED
_SIZE, _RESIDUAL, _ERROR = 0.02, 2e-4, 2e-4
_TURNED_FROM: Version = (4, 2)
_ORIGIN: Vector = (0.0, 0.0, 0.0)
_NOWHERE: Pose = (_ORIGIN, (1.0, 0.0, 0.0, 0.0))


@dataclass(frozen=True, slots=True)
class RigidBodyAsset:
    """One rigid body of the operator's project and the names of its markers."""

    name: str
    markers: tuple[str, ...]
    id: int
    """Streaming id."""
    positions: tuple[Vector, ...] = ()
    """Markers in the body, m, for the description; zeros if not given."""


@dataclass(frozen=True, slots=True)
class FrameStamps:
    """Frame number and server ticks of one frame."""

    number: int
    timestamp: float
    exposure: int
    received: int
    transmit: int
    params: int


def model_definition(bodies: tuple[RigidBodyAsset, ...], version: Version) -> ModelDefinition:
    """Return the descriptions of `bodies` as Motive orders them.

    Parameters
    ----------
    bodies : tuple of StagedBody
        What the operator made.
    version : (int, int)
        From 4.0 bodies name their markers; from 4.2 they carry the offset quaternion that the one
        client which knows 4.2 expects.
    """
    every = tuple(f"{body.name}_{i}" for body in bodies for i in range(1, len(body.markers) + 1))
    sets = [MarkerSetDescription(body.name, body.markers) for body in bodies]
    described = [
        BodyDescription(
            body.name,
            body.id,
            positions=body.positions or (_ORIGIN,) * len(body.markers),
            labels=(0,) * len(body.markers),
            markers=body.markers if version >= NAMES_FROM else (),
            rotation=(0.0, 0.0, 0.0, 1.0) if version >= _TURNED_FROM else None,
        )
        for body in bodies
    ]
    return ModelDefinition((*described, *sets, MarkerSetDescription("all", every)))


class NatNetFrameBuilder:
    """Makes frames; remembers where everything was last seen."""

    def __init__(self, bodies: tuple[RigidBodyAsset, ...], up_axis: Axis, hiding: Hiding) -> None:
        self.bodies = bodies
        self._hiding = hiding
        self._place, self._turn = _AXES[up_axis]
        self._poses: dict[str, Pose] = {}
        self._markers: dict[str, Vector] = {}

    def frame(self, stamps: FrameStamps, markers: Markers, bodies: Bodies) -> FrameOfData:
        """Return one frame.

        Parameters
        ----------
        stamps : Stamps
            Its number and its times.
        markers : mapping of str to (x, y, z) or None
            World z up, m; None is hidden. Those of no body are sent as unlabeled.
        bodies : mapping of str to pose or None
            Position, m, and q_world_body (w, x, y, z); None is not tracked.
        """
        self._markers |= {name: self._place(*at) for name, at in markers.items() if at is not None}
        self._poses |= {
            name: self._posed(pose) for name, pose in bodies.items() if pose is not None
        }
        owned = {name for body in self.bodies for name in body.markers}
        loose = [name for name, at in markers.items() if at is not None and name not in owned]
        sets = [self._set(body, markers) for body in self.bodies]
        every = MarkerSet("all", tuple(at for one in sets for at in one.positions))
        return FrameOfData(
            stamps.number,
            stamps.timestamp,
            stamps.exposure,
            stamps.received,
            stamps.transmit,
            stamps.params,
            bodies=tuple(self._body(body, bodies.get(body.name)) for body in self.bodies),
            markers=tuple(m for body in self.bodies for m in self._labeled(body, markers)),
            marker_sets=(*sets, every),
            other_markers=tuple(self._markers[name] for name in loose),
        )

    def _posed(self, pose: Pose) -> Pose:
        return self._place(*pose[0]), self._turn(*pose[1])

    def _body(self, body: RigidBodyAsset, pose: Pose | None) -> Body:
        (x, y, z), (w, i, j, k) = self._poses.get(body.name, _NOWHERE)
        params = 0 if pose is None else BODY_TRACKED
        return Body(body.id, x, y, z, i, j, k, w, _ERROR, params)

    def _set(self, body: RigidBodyAsset, markers: Markers) -> MarkerSet:
        filled = self._hiding == "filled"
        return MarkerSet(
            body.name,
            tuple(
                self._markers.get(name, _ORIGIN)
                if filled or markers.get(name) is not None
                else _ORIGIN
                for name in body.markers
            ),
        )

    def _labeled(self, body: RigidBodyAsset, markers: Markers) -> list[LabeledMarker]:
        found = []
        for member, name in enumerate(body.markers, 1):
            seen = markers.get(name) is not None
            if seen or (self._hiding == "filled" and name in self._markers):
                x, y, z = self._markers[name]
                params = _SEEN if seen else _FILLED
                found.append(
                    LabeledMarker(body.id << 16 | member, x, y, z, _SIZE, params, _RESIDUAL)
                )
        return found


# --- axes: from z up to the server's up axis --------------------------------------------------


def _to_x(x: float, y: float, z: float) -> Vector:
    return z, y, -x


def _to_y(x: float, y: float, z: float) -> Vector:
    return x, z, -y


def _to_z(x: float, y: float, z: float) -> Vector:
    return x, y, z


def _turned_x(w: float, x: float, y: float, z: float) -> Quaternion:
    return _HALF * (w - y), _HALF * (x + z), _HALF * (y + w), _HALF * (z - x)


def _turned_y(w: float, x: float, y: float, z: float) -> Quaternion:
    return _HALF * (w + x), _HALF * (x - w), _HALF * (y + z), _HALF * (z - y)


def _turned_z(w: float, x: float, y: float, z: float) -> Quaternion:
    return w, x, y, z


_AXES = {"x": (_to_x, _turned_x), "y": (_to_y, _turned_y), "z": (_to_z, _turned_z)}
