r"""Gauge freedom: directions in which markers may move without changing the tracking error.

A segment on a ball joint may be turned about the joint together with all its markers, and
inverse kinematics turns it back: the error stays, the joint angle is another. Such directions are
the null space of the reduced normal matrix without a prior,

.. math:: S = \sum_t C_t - B_t^T A_t^{-1} B_t

divided by the frames. Locks and priors fix them; otherwise `fixed_by` is "nothing".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array

_ZERO = 1e-6
"""Eigenvalues of S/T are squared metres per squared metre, 1 for a marker nothing else depends on:
values below this are rounding."""
_WEAK = 0.01
"""Below this a movement of 10 mm costs less than 1 mm of error."""
_NAMED = 0.1
"""Share of a direction's square that a marker must have to be named."""


@dataclass(frozen=True, slots=True)
class Gauge:
    """Freedom of the markers that the data of these trials leave open."""

    eigenvalues: Array
    """Eigenvalues of S/T over the unlocked coordinates, ascending; 1 is a fully observed marker."""
    free: int
    """How many are zero: moves that no tracking error shows."""
    weak: int
    """How many are not zero and still below 0.01."""
    involved: tuple[str, ...]
    """Markers that the free moves carry, the most moved first."""
    fixed_by: str
    """What fixes the free directions: "locks", "prior" or "nothing"."""


def gauge_of(S: Array, frames: int, coordinates: Sequence[str], *, prior: float) -> Gauge:
    """Return the freedom that S shows.

    Parameters
    ----------
    S
        Reduced normal matrix without prior and without damping, shape (n, n).
    frames
        Frames it was summed over.
    coordinates
        Marker of every row, length n.
    prior
        Weight of the nominal positions; 0 holds nothing.
    """
    if not len(S):
        return Gauge(np.empty(0), 0, 0, (), "locks")
    values, vectors = np.linalg.eigh(S / frames)
    free = int((values < _ZERO).sum())
    weak = int((values < _WEAK).sum()) - free
    held = "locks" if free == 0 else "prior" if prior > 0.0 else "nothing"

    # Markers whose coordinates lie most in the null space.
    shares: dict[str, float] = {}
    for name, share in zip(coordinates, (vectors[:, :free] ** 2).sum(axis=1), strict=True):
        shares[name] = shares.get(name, 0.0) + float(share)
    named = [name for name, share in shares.items() if share >= _NAMED]
    involved = tuple(sorted(named, key=lambda name: -shares[name]))
    return Gauge(values, free, weak, involved, held)
