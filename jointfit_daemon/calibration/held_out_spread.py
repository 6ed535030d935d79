r"""How wrong a correction is, axis by axis, from frames that its fit has not seen.

.. math:: \sigma_j^2(r) = a_j + b_j \min(r, 30)

with r the leverage of a frame over the training's 0.995 quantile: how far the pose lies outside
what training has shown.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from numpy.typing import NDArray

    Array = NDArray[np.float64]

FARTHEST = 30.0
"""Leverage ratios beyond tell nothing more."""
FAR, FAR_FACTOR, FAR_SHARE = 2.0, 3.0, 0.3
"""With one trial: at this ratio errors are taken to be so many times larger, and this counts as
much as so many parts of the trial."""
PASSES = 5
SMALLEST_VARIANCE = 1e-8
HULL_PENALTY = 1e-2


@dataclass(frozen=True, slots=True)
class Spread:
    """Variances of the three axes by distance from training."""

    inside: tuple[float, float, float]
    """a, rad^2."""
    outside: tuple[float, float, float]
    """b, rad^2."""

    def at(self, ratio: float) -> tuple[float, float, float]:
        """Return the standard deviations about x, y and z of the segment, rad."""
        r = min(ratio, FARTHEST)
        a, b = self.inside, self.outside
        return (sqrt(a[0] + b[0] * r), sqrt(a[1] + b[1] * r), sqrt(a[2] + b[2] * r))

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {"inside": list(self.inside), "outside": list(self.outside)}

    @staticmethod
    def read(data: Mapping[str, Any]) -> Spread:
        """Return what `to_dict` described."""
        return Spread(_three(data["inside"]), _three(data["outside"]))


def hull(smooth: Array) -> Array:
    """Return the matrix of leverages n s^T (S^T S + n p I)^-1 s of scaled smooth terms."""
    n, p = smooth.shape
    scales = np.sqrt(np.mean(smooth**2, axis=0)) + 1e-3
    g = smooth / scales
    inverse = n * np.linalg.inv(g.T @ g + n * HULL_PENALTY * np.eye(p))
    found: Array = 0.5 * (inverse + inverse.T) / np.outer(scales, scales)
    return found


def measure_spread(
    smooth: Array,
    residuals: Sequence[Array],
    ways: Sequence[Sequence[NDArray[np.bool_]]],
) -> Spread:
    """Fit variance against distance over all frames that some fit has not seen.

    Every way of leaving frames out adds its own: blocks of a trial lie near the rest of it, whole
    trials far. With one trial nothing lies far, and the growth outside is that of `FAR_FACTOR`.

    Parameters
    ----------
    smooth : ndarray, shape (n, s)
        Smooth terms of all frames of training.
    residuals : sequence of ndarray, shape (n, 3)
        By way of leaving out: what is left over of each frame when its group is left out, rad.
    ways : sequence of sequence of ndarray of bool, shape (n,)
        By way of leaving out: the groups.
    """
    ratios = np.concatenate([_ratios(smooth, groups) for groups in ways])
    squares = np.concatenate([each**2 for each in residuals])
    shares = np.full(len(ratios), 1.0 / len(ratios))
    found = [_line(ratios, square, shares, alone=len(ways) == 1) for square in squares.T]
    (ax, bx), (ay, by), (az, bz) = found
    return Spread((ax, ay, az), (bx, by, bz))


def _ratios(smooth: Array, groups: Sequence[NDArray[np.bool_]]) -> Array:
    """Return how far each frame lies outside all groups but its own."""
    ratios = np.empty(len(smooth))
    for held in groups:
        matrix = hull(smooth[~held])
        h = np.einsum("ij,jk,ik->i", smooth, matrix, smooth)
        ratios[held] = h[held] / np.quantile(h[~held], 0.995)
    return np.minimum(ratios, FARTHEST)


def _line(ratios: Array, squares: Array, shares: Array, *, alone: bool) -> tuple[float, float]:
    """Return a, b >= 0 of E(square) = a + b r: gamma regression, five passes."""
    typical = float(np.mean(squares)) + SMALLEST_VARIANCE
    if alone:
        ratios = np.append(ratios, FAR)
        squares = np.append(squares, FAR_FACTOR**2 * typical)
        shares = np.append(shares, FAR_SHARE)
    design = np.stack([np.ones_like(ratios), ratios], axis=1)
    from scipy.optimize import nnls  # noqa: PLC0415 - fits need it, a running daemon does not

    line = np.array([typical, 0.0])
    for _ in range(PASSES):
        scale = np.sqrt(shares) / (design @ line)
        line = nnls(design * scale[:, None], squares * scale)[0]
        line[0] = max(line[0], 0.1 * typical)
    return float(line[0]), float(line[1])


def _three(values: Sequence[float]) -> tuple[float, float, float]:
    x, y, z = (float(value) for value in values)
    return (x, y, z)
