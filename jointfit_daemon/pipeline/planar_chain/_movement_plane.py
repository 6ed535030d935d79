"""The plane of a movement, estimated from the positions of all markers.

Each marker of a planar movement moves in its own plane, and these planes are parallel. The pooled
scatter of the markers about their own means therefore has its smallest eigenvalue along the common
normal.
"""

from __future__ import annotations

from math import sqrt
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

FEWEST_FRAMES = 40
"""Smallest number of frames for the estimate of a plane, equal to 2 s at 20 Hz."""
LEAST_MOVEMENT_M = 0.01
"""RMS movement along the smaller principal direction in the plane, m. Below this value, the plane
is not determined."""
MOST_OFF_M = 0.02
"""RMS distance of the markers from their planes, m. Above this value, the movement is not
planar."""
MOST_RATIO = 0.5
"""Ratio of the movement out of the plane to the smaller principal movement in the plane. Above this
value, the movement is not planar."""


class MovementPlane(NamedTuple):
    """Estimated plane of a movement."""

    normal: Array | None
    """Unit normal in the world, shape (3,); None if there is no plane."""
    off_plane: float | None
    """RMS distance of the markers from their planes, m."""
    refused: str | None
    """Reason why there is no plane, and the remedy."""


class PlaneEstimator:
    r"""Estimates the plane of movement from a sequence of frames.

    x_tm is the position of marker m in frame t, and x̄_m is its weighted mean. The weight w_t of a
    frame decreases with age. The scatter is

    .. math:: S = \sum_m \sum_t w_t (x_{tm} - \bar x_m)(x_{tm} - \bar x_m)^T

    The normal is the eigenvector of S with the smallest eigenvalue.

    Parameters
    ----------
    count : int
        Number of markers.
    forgetting : float
        Factor by which the weight of a frame decreases per frame, in (0, 1].
    """

    def __init__(self, count: int, forgetting: float) -> None:
        self._forgetting = forgetting
        self._weights = np.zeros(count)
        self._means = np.zeros((count, 3))
        self._scatter = np.zeros((3, 3))
        self.frames = 0

    def feed(self, markers: Array) -> None:
        """Process the marker positions of one frame, m, shape (count, 3); NaN where missing."""
        seen = np.isfinite(markers).all(axis=1)
        self._weights *= self._forgetting
        self._scatter *= self._forgetting
        if not seen.any():
            return
        self._weights[seen] += 1.0

        # Update mean and scatter of every marker incrementally.
        away = markers[seen] - self._means[seen]
        share = 1.0 / self._weights[seen]
        self._means[seen] += share[:, None] * away
        self._scatter += (away * (1.0 - share)[:, None]).T @ away
        self.frames += 1

    def estimate(self) -> MovementPlane:
        """Return the plane estimated from all frames so far."""
        if self.frames < FEWEST_FRAMES:
            return MovementPlane(None, None, "plane not known yet: move the joints")
        values, vectors = np.linalg.eigh(self._scatter / self._weights.sum())
        out, least = (sqrt(max(float(value), 0.0)) for value in values[:2])
        if least < LEAST_MOVEMENT_M:
            reason = (
                f"movement too small or along one line: {1e3 * least:.0f} mm RMS across it, "
                f"expected {1e3 * LEAST_MOVEMENT_M:.0f} mm or more: move the joints further"
            )
            return MovementPlane(None, out, reason)
        if out > (limit := min(MOST_OFF_M, MOST_RATIO * least)):
            reason = (
                f"the movement is not planar: {1e3 * out:.0f} mm RMS out of the plane, expected "
                f"at most {1e3 * limit:.0f} mm: move in one plane"
            )
            return MovementPlane(None, out, reason)
        normal = vectors[:, 0]
        sign = np.sign(normal[np.abs(normal).argmax()])  # Use the same sign for similar planes.
        return MovementPlane(np.asarray(sign * normal), out, None)
