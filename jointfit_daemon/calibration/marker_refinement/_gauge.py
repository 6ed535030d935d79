r"""Gauge freedom: directions in which markers may move without changing the tracking error.

For example, all markers of a segment on a ball joint may be rotated about the joint together.
Inverse kinematics then rotates the segment back, so that the error is equal, but the joint angle
differs. Such directions are the null space of the reduced normal matrix of `_simultaneous` without
a prior,

.. math:: S = \sum_t C_t - B_t^T A_t^{-1} B_t

divided by the number of frames. Locked coordinates or a prior make these directions determinate;
otherwise `fixed_by` is "nothing".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array

_ZERO = 1e-6
"""Limit of an eigenvalue of S/T, where T is the number of frames; without unit. A smaller
eigenvalue is attributed to rounding. A marker that is independent of all others has the eigenvalue
1.
"""
_WEAK = 0.01
"""Eigenvalue below which a displacement of 10 mm increases the error by less than 1 mm."""
_NAMED = 0.1
"""Smallest sum of the squared components of a listed marker in the free directions."""


@dataclass(frozen=True, slots=True)
class Gauge:
    """Directions of marker displacement that the data of the trials do not determine."""

    eigenvalues: Array
    """Eigenvalues of S/T over the unlocked coordinates in ascending order. The eigenvalues of a
    fully observed marker are 1.
    """
    free: int
    """Number of zero eigenvalues. Their eigenvectors are displacements without effect on the
    tracking error.
    """
    weak: int
    """Number of non-zero eigenvalues below 0.01."""
    involved: tuple[str, ...]
    """Markers that move along the free directions, in order of decreasing displacement."""
    fixed_by: str
    """Constraint of the free directions: "prior" or "nothing"; "locks" if no direction is free."""


def gauge_of(S: Array, frames: int, coordinates: Sequence[str], *, prior: float) -> Gauge:
    """Return the gauge freedom from the reduced normal matrix S.

    Parameters
    ----------
    S
        Reduced normal matrix without prior and without damping, shape (n, n).
    frames
        Number of frames in the sum.
    coordinates
        Name of the marker of every row, length n.
    prior
        Weight of the nominal positions; 0 for no prior.
    """
    if not len(S):
        return Gauge(np.empty(0), 0, 0, (), "locks")
    values, vectors = np.linalg.eigh(S / frames)
    free = int((values < _ZERO).sum())
    weak = int((values < _WEAK).sum()) - free
    held = "locks" if free == 0 else "prior" if prior > 0.0 else "nothing"

    # Find the markers whose coordinates contribute most to the null space.
    shares: dict[str, float] = {}
    for name, share in zip(coordinates, (vectors[:, :free] ** 2).sum(axis=1), strict=True):
        shares[name] = shares.get(name, 0.0) + float(share)
    named = [name for name, share in shares.items() if share >= _NAMED]
    involved = tuple(sorted(named, key=lambda name: -shares[name]))
    return Gauge(values, free, weak, involved, held)
