"""Conversion of one NatNet frame to columns: SI units, world z up, NaN for missing data.

The server marks missing data. If bit 0 of the params of a body is clear, the body repeats its last
valid pose. A labeled marker that is not visible is absent, or it is flagged as occluded and has an
estimated position. A missing position in a marker set is (0, 0, 0). A labeled marker is usable if
its flags state that the cameras measured it ("point-cloud solved") and that it is not occluded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray  # noqa: TC002 - mypyc evaluates the types of fields

from jointfit_drivers.motion_capture import (
    ABSENT,
    FARTHEST_M,
    NO_POSITION,
    is_near,
    rows_array,
    unit_quaternion,
    world_rotation,
)
from jointfit_drivers.natnet._binding import body_key
from jointfit_protocols.natnet import BODY_TRACKED, MARKER_OCCLUDED, MARKER_POINT_CLOUD_SOLVED

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion, Vector
    from jointfit_drivers.motion_capture import ColumnKey
    from jointfit_drivers.natnet._binding import Binding
    from jointfit_protocols.natnet import FrameOfData

_QUALITY_BITS = MARKER_OCCLUDED | MARKER_POINT_CLOUD_SOLVED


class FrameColumns(NamedTuple):
    """Arrays of one `MocapFrame`, and findings about the frame."""

    markers: NDArray[np.float64]
    body_positions: NDArray[np.float64]
    body_orientations: NDArray[np.float64]
    residuals: NDArray[np.float64]
    """Residual of each labeled marker, m per camera ray; NaN if missing or zero."""
    suspicious: int
    """Number of tracked bodies that were rejected because the norm of the quaternion is not 1, or
    because a coordinate is not finite or implausibly large."""
    unknown: tuple[int, ...]
    """Ids of bodies and markers that the model definition of the server does not contain."""


class PoseConverter:
    """Converts frames of one server to columns.

    Parameters
    ----------
    up_axis : {"x", "y", "z"}
        Axis of the stream that points up. The **world** is rotated: p' = R p and q' = q_R q, where
        q_R is the quaternion of the rotation matrix R. The axes of a body remain as the vendor
        defines them.
    """

    def __init__(self, up_axis: str) -> None:
        self._place, self._turn = world_rotation(up_axis)

    def columns(self, frame: FrameOfData, binding: Binding) -> FrameColumns:
        """Return the data of `frame` in the columns of `binding`."""
        unknown: list[int] = []

        place = self._place
        seen, errors = self._labeled_markers(frame, binding.known, unknown)
        for asset in frame.assets:
            for number, x, y, z, _, params, _ in asset.markers:
                if params & _QUALITY_BITS == MARKER_POINT_CLOUD_SOLVED and is_near(x, y, z):
                    seen.setdefault(body_key(asset.id, number), place(x, y, z))

        for marker_set in frame.marker_sets:
            if marker_set.name in binding.loose_sets:
                for i, (x, y, z) in enumerate(marker_set.positions):
                    if (x or y or z) and is_near(x, y, z):
                        seen[marker_set.name, i] = place(x, y, z)

        bodies, suspicious = self._bodies(frame, binding, unknown)
        places = [bodies.get(key, ABSENT) for key in binding.columns.bodies]
        residuals = np.array(list(map(errors.get, binding.columns.markers)), dtype=np.float64)
        residuals[residuals <= 0.0] = np.nan  # absent markers are NaN already

        return FrameColumns(
            rows_array([seen.get(key, NO_POSITION) for key in binding.columns.markers], 3),
            rows_array([place for place, _ in places], 3),
            rows_array([turn for _, turn in places], 4),
            residuals,
            suspicious,
            tuple(unknown),
        )

    def _labeled_markers(
        self, frame: FrameOfData, known: frozenset[ColumnKey], unknown: list[int]
    ) -> tuple[dict[ColumnKey, Vector], dict[ColumnKey, float]]:
        """Return positions and residuals of the usable labeled markers."""
        place, far = self._place, FARTHEST_M
        seen: dict[ColumnKey, Vector] = {}
        errors: dict[ColumnKey, float] = {}
        twice: set[int] = set()
        for number, x, y, z, _, params, residual in frame.markers:
            if number not in known:
                if number >> 16:  # id of the model; 0 is a marker without a model
                    unknown.append(number)
            # The test equals is_near, whose call would take a third of the time of this loop.
            elif (
                params & _QUALITY_BITS == MARKER_POINT_CLOUD_SOLVED
                and -far <= x <= far
                and -far <= y <= far
                and -far <= z <= far
            ):
                if number in seen:
                    twice.add(number)
                seen[number] = place(x, y, z)
                errors[number] = residual

        for number in twice:
            del seen[number], errors[number]
        return seen, errors

    def _bodies(
        self, frame: FrameOfData, binding: Binding, unknown: list[int]
    ) -> tuple[dict[ColumnKey, tuple[Vector, Quaternion]], int]:
        seen: dict[ColumnKey, tuple[Vector, Quaternion]] = {}
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
                seen.pop(key, None)  # bodies with the same id are ambiguous
            elif params & BODY_TRACKED:
                q = unit_quaternion(qw, qx, qy, qz)
                if q is not None and is_near(x, y, z):
                    seen[key] = (self._place(x, y, z), self._turn(*q))
                else:
                    suspicious += 1
            met.add(key)
        return seen, suspicious
