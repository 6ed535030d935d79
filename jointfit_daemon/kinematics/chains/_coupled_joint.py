r"""Coupled joints, such as a knee: rotation and translation are functions of one coordinate.

The pose consists of a quaternion p and a shift s. Each component is a cubic spline of the
coordinate q between samples; the quaternion is normalized afterwards. Per unit of q the segment
rotates by ω and translates by v, both in segment axes:

.. math:: \omega = 2\,vec(\bar p\, p') / |p|^2, \qquad v = R^T s'

vec is the vector part of a quaternion, R the rotation matrix of p, and p' and s' are the exact
derivatives of the splines with respect to q. Beyond the samples, p and s are extrapolated linearly.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import CubicSpline

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array

_GUESSES = 91
"""Number of start coordinates that ``CoupledCurve.nearest`` tries."""
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]
COLUMNS = 10
"""Number of values per coupling: coordinate q, shift (3), omega (3), v (3)."""


@dataclass(frozen=True, slots=True)
class CoupledCurve:
    """Pose of a segment in its parent as a function of one coordinate."""

    knots: Array
    """Coordinates of the samples, shape (n,), increasing."""
    pieces: Array
    """Cubic coefficients of (w, x, y, z) and the shift, highest power first, shape (4, n - 1, 7).
    """
    starts: list[float]
    """Values of `knots` as plain floats."""
    rows: list[list[list[float]]]
    """Coefficients in `pieces` as plain floats, by piece, then by component."""

    @classmethod
    def through(cls, path: Sequence[Sequence[float]]) -> CoupledCurve:
        """Return the curve through samples (q, w, x, y, z, shift), shape (n, 8), with rising q."""
        rows = np.array(path, dtype=np.float64)
        q = rows[:, 1:5]
        flips = np.cumprod(np.where((q[1:] * q[:-1]).sum(axis=1) < 0.0, -1.0, 1.0))
        # a quaternion and its negative are the same rotation, but a spline needs continuous signs
        rows[1:, 1:5] *= flips[:, None]
        pieces = np.asarray(CubicSpline(rows[:, 0], rows[:, 1:]).c)
        return cls(rows[:, 0], pieces, rows[:, 0].tolist(), pieces.transpose(1, 2, 0).tolist())

    @property
    def home(self) -> float:
        """Coordinate at rest, which is zero or the nearest coordinate within the samples."""
        return float(np.clip(0.0, self.knots[0], self.knots[-1]))

    def at(self, amounts: Array) -> tuple[Array, Array]:
        """Return rotations to the parent, shape (T, 3, 3), and couplings, shape (T, 10).

        Parameters
        ----------
        amounts
            Coordinates, rad, shape (T,).
        """
        if len(amounts) == 1:
            return self._at_one(float(amounts[0]))
        inside = np.clip(amounts, self.knots[0], self.knots[-1])
        piece = np.clip(np.searchsorted(self.knots, inside) - 1, 0, len(self.knots) - 2)
        a, b, c, d = self.pieces[:, piece]
        h = (inside - self.knots[piece])[:, None]
        slope = (3.0 * a * h + 2.0 * b) * h + c
        p = ((a * h + b) * h + c) * h + d + slope * (amounts - inside)[:, None]

        square = (p[:, :4] ** 2).sum(axis=1, keepdims=True)
        R = rotation.to_matrix(p[:, :4] / np.sqrt(square))

        found = np.empty((len(p), COLUMNS))
        found[:, 0], found[:, 1:4] = amounts, p[:, 4:]
        w, v, dw, dv = p[:, :1], p[:, 1:4], slope[:, :1], slope[:, 1:4]
        across = v[:, _NEXT] * dv[:, _LAST] - v[:, _LAST] * dv[:, _NEXT]
        found[:, 4:7] = 2.0 * (w * dv - dw * v - across) / square
        found[:, 7:] = (slope[:, None, 4:] @ R)[:, 0]
        return R, found

    def _at_one(self, amount: float) -> tuple[Array, Array]:
        """Return ``at`` for one instant; plain floats are ten times faster than arrays."""
        starts = self.starts
        inside = min(max(amount, starts[0]), starts[-1])
        piece = min(max(bisect_left(starts, inside) - 1, 0), len(starts) - 2)
        h, beyond = inside - starts[piece], amount - inside
        p, slope = [], []
        for a, b, c, d in self.rows[piece]:
            s = (3.0 * a * h + 2.0 * b) * h + c
            p.append(((a * h + b) * h + c) * h + d + s * beyond)
            slope.append(s)

        w, x, y, z, *shift = p
        dw, dx, dy, dz, *ds = slope
        n = 2.0 / (w * w + x * x + y * y + z * z)
        xx, yy, zz, xy, xz, yz = n * x * x, n * y * y, n * z * z, n * x * y, n * x * z, n * y * z
        wx, wy, wz = n * w * x, n * w * y, n * w * z
        R = (
            (1 - yy - zz, xy - wz, xz + wy),
            (xy + wz, 1 - xx - zz, yz - wx),
            (xz - wy, yz + wx, 1 - xx - yy),
        )

        turns = (
            n * (w * dx - dw * x - y * dz + z * dy),
            n * (w * dy - dw * y - z * dx + x * dz),
            n * (w * dz - dw * z - x * dy + y * dx),
        )
        slides = [sum(R[i][j] * ds[i] for i in range(3)) for j in range(3)]
        return np.array((R,)), np.array(((amount, *shift, *turns, *slides),))

    def nearest(self, turned: Array) -> Array:
        """Return the coordinates, (T,), of the poses nearest to rotations, (T, 3, 3).

        Each result is one of `_GUESSES` evenly spaced coordinates.
        """
        tried = np.linspace(self.knots[0], self.knots[-1], _GUESSES)
        match = turned.reshape(-1, 9) @ self.at(tried)[0].reshape(-1, 9).T
        return np.asarray(tried[match.argmax(axis=1)])
