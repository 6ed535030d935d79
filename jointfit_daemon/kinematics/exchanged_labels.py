"""Detection of exchanged marker labels from measured positions and model positions."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.optimize import linear_sum_assignment

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

EXCHANGE_GAIN = 0.2
"""Ratio of the summed squared distances after and before an exchange of labels, below which the
labels count as exchanged."""


def find_exchanged_labels(
    places: Array, measured: Array, far: NDArray[np.bool_]
) -> list[tuple[int, ...]]:
    """Return groups of far markers that fit the model much better after an exchange of labels.

    Parameters
    ----------
    places
        Positions of the markers in the model, m, shape (M, 3).
    measured
        Measured positions, m, shape (M, 3).
    far
        Mask of the markers whose measured position is far from the model position, shape (M,).

    Returns
    -------
    list of tuple of int
        Groups of indices. Each marker of a group is at the model position of the next marker, and
        the last marker is at the model position of the first.
    """
    rows = np.flatnonzero(far)
    square = ((places[rows, None] - measured[None, rows]) ** 2).sum(axis=-1)
    # marker at each model position after the best assignment of all labels
    nearest = linear_sum_assignment(square)[1]
    place_of = np.argsort(nearest)

    groups: list[tuple[int, ...]] = []
    left = set(range(len(rows)))
    for first in range(len(rows)):
        group = [first]
        while (following := int(place_of[group[-1]])) != first:
            group.append(following)
        if first != min(group) or len(group) == 1:
            continue
        if square[place_of[group], group].sum() < EXCHANGE_GAIN * square[group, group].sum():
            groups.append(tuple(rows[group].tolist()))
            left -= set(group)

    # One misplaced marker may have caused a wrong assignment of two other markers.
    own = square.diagonal()
    better = square + square.T < EXCHANGE_GAIN * (own[:, None] + own[None])
    for i, j in np.argwhere(np.triu(better, 1)).tolist():
        if {i, j} <= left:
            groups.append((int(rows[i]), int(rows[j])))
            left -= {i, j}
    return groups
