"""Conversion of the components of one QTM frame to columns: SI units, world z up, NaN if missing.

The server sends positions in millimetres and rotation matrices in column-major order. For a missing
marker or body, all bits of its numbers are set. Every position that is not finite counts as
missing.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.units import M_PER_MM
from jointfit_drivers.motion_capture import (
    ABSENT,
    FARTHEST_M,
    is_near,
    matrix_quaternion,
    rows_array,
    unit_quaternion,
    world_rotation,
)
from jointfit_drivers.qtm._binding import segment_key
from jointfit_protocols.qtm import ComponentType, ItemsComponent, SkeletonComponent

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Quaternion, Vector
    from jointfit_drivers.qtm._binding import QtmBinding
    from jointfit_protocols.qtm import Component

_ROTATION = slice(3, 12)


class QtmColumns(NamedTuple):
    """Arrays of one `MocapFrame`."""

    markers: Array
    body_positions: Array
    body_orientations: Array
    residuals: Array
    """Residual of each marker, m; NaN if missing or zero."""
    suspicious: int
    """Number of bodies and segments that have a position but no valid rotation."""


class QtmPoseConverter:
    """Converts frames of one server to columns.

    Parameters
    ----------
    up_axis : UpAxis
        Axis of the stream that points up.
    """

    def __init__(self, up_axis: str) -> None:
        self._place, self._turn = world_rotation(up_axis)
        units = [self._place(*axis) for axis in np.eye(3).tolist()]
        self._rotation = np.array(units)

    def columns(
        self, components: Mapping[int, Component], binding: QtmBinding
    ) -> QtmColumns | None:
        """Return the frame in the columns of `binding`; None if it does not fit the settings."""
        markers = components.get(ComponentType.MARKERS_RESIDUAL)
        count = len(markers.items) if isinstance(markers, ItemsComponent) else None
        if count is not None and count != binding.labels:
            return None

        poses: dict[int, tuple[Vector, Quaternion]] = {}
        suspicious = 0
        bodies = components.get(ComponentType.BODIES_RESIDUAL)
        if isinstance(bodies, ItemsComponent):
            places = binding.body_places(len(bodies.items))
            if places is None:
                return None
            for place, item in zip(places, bodies.items, strict=True):
                x, y, z = item[0] * M_PER_MM, item[1] * M_PER_MM, item[2] * M_PER_MM
                if not is_near(x, y, z):
                    continue
                r = item[_ROTATION]  # column-major
                q = matrix_quaternion((r[0], r[3], r[6], r[1], r[4], r[7], r[2], r[5], r[8]))
                if q is None:
                    suspicious += 1
                else:
                    poses[place] = self._place(x, y, z), self._turn(*q)

        skeletons = components.get(ComponentType.SKELETON)
        if isinstance(skeletons, SkeletonComponent):
            if len(skeletons.skeletons) != binding.skeletons:
                return None
            suspicious += self._segments(skeletons, poses)

        rows = [poses.get(key, ABSENT) for key in binding.body_keys]
        items = markers.items if isinstance(markers, ItemsComponent) else ()
        columns = binding.marker_places
        placed = np.full((len(columns), 3), np.nan)
        residuals = np.full(len(columns), np.nan)
        if items:
            numbers = np.array(items, dtype=np.float64) * M_PER_MM
            numbers[~(np.abs(numbers[:, :3]) <= FARTHEST_M).all(axis=1)] = np.nan
            placed = numbers[columns, :3] @ self._rotation
            residuals = numbers[columns, 3]
            residuals[~(residuals > 0.0)] = np.nan  # estimated positions have residual 0
        return QtmColumns(
            placed,
            rows_array([place for place, _ in rows], 3),
            rows_array([turn for _, turn in rows], 4),
            residuals,
            suspicious,
        )

    def _segments(
        self, component: SkeletonComponent, poses: dict[int, tuple[Vector, Quaternion]]
    ) -> int:
        """Add the poses of skeleton segments to `poses`; return the number of rejected poses."""
        suspicious = 0
        for number, segments in enumerate(component.skeletons):
            for segment in segments:
                x, y, z = segment.x * M_PER_MM, segment.y * M_PER_MM, segment.z * M_PER_MM
                if not is_near(x, y, z):
                    continue
                q = unit_quaternion(segment.qw, segment.qx, segment.qy, segment.qz)
                if q is None:
                    suspicious += 1
                else:
                    key = segment_key(number, segment.id)
                    poses[key] = self._place(x, y, z), self._turn(*q)
        return suspicious
