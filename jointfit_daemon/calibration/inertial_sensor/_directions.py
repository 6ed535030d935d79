"""Directions of a measured vector in sensor axes: normals of faces, edges and corners of a cube."""

from __future__ import annotations

from itertools import product
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Collection

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

_SIGNS = sorted(
    (signs for signs in product((1, 0, -1), repeat=3) if any(signs)),
    key=lambda signs: (sum(map(abs, signs)), [-abs(sign) for sign in signs], [-s for s in signs]),
)
DIRECTIONS: Array = np.array([np.array(signs) / np.linalg.norm(signs) for signs in _SIGNS])
"""Unit vectors, shape (26, 3): 6 faces, 12 edges, 8 corners."""
FACES = 6
"""Number of faces, which are the first directions in `DIRECTIONS`."""
NAMES = tuple(
    " ".join(
        f"{'+' if sign > 0 else '-'}{axis}" for axis, sign in zip("xyz", s, strict=True) if sign
    )
    for s in _SIGNS
)
"""Names of the directions, such as ``+x`` or ``+x -z``."""


def nearest_direction(vectors: Array) -> NDArray[np.intp]:
    """Return the index of the direction nearest to each vector, shape (n,).

    Parameters
    ----------
    vectors
        Vectors in sensor axes of any length except 0, shape (n, 3).
    """
    return np.asarray(np.argmax(vectors @ DIRECTIONS.T, axis=1))


def direction_names(indices: Collection[int]) -> tuple[str, ...]:
    """Return the names of directions, faces first."""
    return tuple(NAMES[index] for index in sorted(indices))
