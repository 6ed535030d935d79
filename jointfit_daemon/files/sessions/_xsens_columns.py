"""Columns of the text files of Xsens programs: orientations, vectors and counters."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array

_QUATERNIONS = (
    ("Quat_q0", "Quat_q1", "Quat_q2", "Quat_q3"),
    ("Quat_w", "Quat_x", "Quat_y", "Quat_z"),
    ("Quat_W", "Quat_X", "Quat_Y", "Quat_Z"),
)
_EULER = (("Roll", "Pitch", "Yaw"), ("Euler_X", "Euler_Y", "Euler_Z"))


def unwrap_counter(counter: Array, turn: int) -> Array:
    """Return a counter's increase since its first row, ticks, shape (n,), without wraps."""
    # A step of more than half the range counts as a step back; the rows are then not in order.
    steps = np.mod(np.diff(counter) + turn / 2, turn) - turn / 2
    counted: Array = np.concatenate([[0.0], np.cumsum(steps)])[: len(counter)]
    return counted


def orientation_columns(columns: Mapping[str, Array], count: int) -> Array:
    """Return orientations q_world_sensor, shape (count, 4); NaN where unknown."""
    for names in _QUATERNIONS:
        if all(name in columns for name in names):
            return rotation.normalize(np.column_stack([columns[name] for name in names]))
    cells = [f"Mat[{row}][{column}]" for row in (1, 2, 3) for column in (1, 2, 3)]
    if all(cell in columns for cell in cells):
        matrices = np.column_stack([columns[cell] for cell in cells]).reshape(-1, 3, 3)
        known = np.isfinite(matrices).all(axis=(1, 2))
        q = np.full((count, 4), np.nan)
        q[known] = rotation.from_matrix(matrices[known])
        return q
    for angles in _EULER:
        if all(name in columns for name in angles):
            # Xsens: R = Rz(yaw) Ry(pitch) Rx(roll), degrees.
            turns = [
                rotation.exp(np.deg2rad(columns[name])[:, None] * np.eye(3)[k])
                for k, name in enumerate(angles)
            ]
            return rotation.multiply(turns[2], rotation.multiply(turns[1], turns[0]))
    return np.full((count, 4), np.nan)


def axes_columns(columns: Mapping[str, Array], pattern: str) -> Array | None:
    """Return the vectors of three columns, shape (n, 3); None if one is missing."""
    parts = [columns.get(pattern.format(axis)) for axis in "XYZ"]
    known = [part for part in parts if part is not None]
    return np.column_stack(known) if len(known) == 3 else None  # noqa: PLR2004 - three axes
