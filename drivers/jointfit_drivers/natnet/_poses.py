"""Conversion of one NatNet frame to columns: SI units, world z up, NaN for missing data.

Missing data are marked by the server. A body whose bit 0 is clear repeats its last valid pose.
A labeled marker is absent, or occluded with a plausible filled position. A position in a marker
set is (0, 0, 0). A usable marker is not occluded **and** point-cloud solved.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray  # noqa: TC002 - mypyc evaluates the types of fields

from jointfit_drivers.natnet._binding import body_key
from jointfit_protocols.natnet import BODY_TRACKED, MARKER_OCCLUDED, MARKER_POINT_CLOUD_SOLVED

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.model import Quaternion, Vector
    from jointfit_drivers.natnet._binding import Binding, Key
    from jointfit_protocols.natnet import FrameOfData

    Place = Callable[[float, float, float], Vector]
    Turn = Callable[[float, float, float, float], Quaternion]

_HALF = math.sqrt(0.5)
_NO_POSITION: Vector = (math.nan, math.nan, math.nan)
_NO_ORIENTATION: Quaternion = (math.nan, math.nan, math.nan, math.nan)
_NORM_TOLERANCE = 1e-3
"""Largest deviation of a quaternion's norm from 1."""
_FARTHEST_M = 10_000.0
"""Largest plausible coordinate, m; NaN compares as larger."""
_QUALITY_BITS = MARKER_OCCLUDED | MARKER_POINT_CLOUD_SOLVED


class FrameColumns(NamedTuple):
    """Arrays of one `MocapFrame`, and the data left out of them."""

    markers: NDArray[np.float64]
    body_positions: NDArray[np.float64]
    body_orientations: NDArray[np.float64]
    suspicious: int
    """Bodies rejected because their quaternion is not normalised or their numbers are not finite.
    """
    unknown: tuple[int, ...]
    """Ids that are not in the model."""


class PoseConverter:
    """Converts frames of one server to columns.

    Parameters
    ----------
    up_axis : {"x", "y", "z"}
        The stream's up axis. The **world** is rotated, p' = R p and q' = q_R q; the axes of a
        body are those of the vendor.
    """

    def __init__(self, up_axis: str) -> None:
        self._place, self._turn = _WORLDS[up_axis]

    def columns(self, frame: FrameOfData, binding: Binding) -> FrameColumns:
        """Return `frame` in the columns of `binding`."""
        unknown: list[int] = []

        place = self._place
        seen = self._labeled(frame, binding.known, unknown)
        for asset in frame.assets:
            for number, x, y, z, _, params, _ in asset.markers:
                if params & _QUALITY_BITS == MARKER_POINT_CLOUD_SOLVED and _near(x, y, z):
                    seen.setdefault(body_key(asset.id, number), place(x, y, z))

        for marker_set in frame.marker_sets:
            if marker_set.name in binding.loose_sets:
                for i, (x, y, z) in enumerate(marker_set.positions):
                    if (x or y or z) and _near(x, y, z):
                        seen[marker_set.name, i] = place(x, y, z)

        bodies, suspicious = self._bodies(frame, binding, unknown)
        places = [bodies.get(key, _ABSENT) for key in binding.bodies]

        return FrameColumns(
            _array([seen.get(key, _NO_POSITION) for key in binding.markers], 3),
            _array([place for place, _ in places], 3),
            _array([turn for _, turn in places], 4),
            suspicious,
            tuple(unknown),
        )

    def _labeled(
        self, frame: FrameOfData, known: frozenset[Key], unknown: list[int]
    ) -> dict[Key, Vector]:
        place, far = self._place, _FARTHEST_M
        seen: dict[Key, Vector] = {}
        twice: set[int] = set()
        for number, x, y, z, _, params, _ in frame.markers:
            if number not in known:
                if number >> 16:  # model 0: a marker without a model
                    unknown.append(number)
            # as _near, which would take a third of the time of this loop
            elif (
                params & _QUALITY_BITS == MARKER_POINT_CLOUD_SOLVED
                and -far <= x <= far
                and -far <= y <= far
                and -far <= z <= far
            ):
                if number in seen:
                    twice.add(number)
                seen[number] = place(x, y, z)

        for number in twice:
            del seen[number]
        return seen

    def _bodies(
        self, frame: FrameOfData, binding: Binding, unknown: list[int]
    ) -> tuple[dict[Key, tuple[Vector, Quaternion]], int]:
        seen: dict[Key, tuple[Vector, Quaternion]] = {}
        met: set[int] = set()
        suspicious = 0
        found = [(body.id, body) for body in frame.bodies]
        for skeleton in frame.skeletons:
            found += [(body_key(skeleton.id, bone.id), bone) for bone in skeleton.bones]
        for asset in frame.assets:
            found += [(body_key(asset.id, body.id), body) for body in asset.bodies]

        for key, (_, x, y, z, qx, qy, qz, qw, _, params) in found:
            if key not in binding.known:
                unknown.append(key)
            elif key in met:
                seen.pop(key, None)  # two bodies with one id cannot be distinguished
            elif params & BODY_TRACKED:
                norm = math.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
                if abs(norm - 1.0) <= _NORM_TOLERANCE and _near(x, y, z):
                    turned = self._turn(qw / norm, qx / norm, qy / norm, qz / norm)
                    seen[key] = (self._place(x, y, z), turned)
                else:
                    suspicious += 1
            met.add(key)
        return seen, suspicious


_ABSENT = (_NO_POSITION, _NO_ORIENTATION)


def _near(x: float, y: float, z: float) -> bool:
    """Return whether a position is finite and plausible."""
    return abs(x) <= _FARTHEST_M and abs(y) <= _FARTHEST_M and abs(z) <= _FARTHEST_M


def _array(rows: list[Vector] | list[Quaternion], width: int) -> NDArray[np.float64]:
    return np.array(rows, dtype=np.float64).reshape(len(rows), width)


_WORLDS: dict[str, tuple[Place, Turn]] = {
    "x": (
        lambda x, y, z: (-z, y, x),
        lambda w, x, y, z: (_HALF * (w + y), _HALF * (x - z), _HALF * (y - w), _HALF * (z + x)),
    ),
    "y": (
        lambda x, y, z: (x, -z, y),
        lambda w, x, y, z: (_HALF * (w - x), _HALF * (x + w), _HALF * (y - z), _HALF * (z + y)),
    ),
    "z": (lambda x, y, z: (x, y, z), lambda w, x, y, z: (w, x, y, z)),
}
"""Rotation of the world that makes z up, for each up axis: -90 deg about y for x, +90 deg about x
for y; applied to positions, and from the left to quaternions.
"""
