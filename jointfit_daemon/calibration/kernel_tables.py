r"""Two experts as the frame loop wants them: everything of one frame in two matrix products.

All exponents of the bumps of both, of the static pose's own among them,

.. math:: -\tfrac12 |x - z|^2 = [z / \ell, -\tfrac12 \ell^{-2}, -\tfrac12 |z|^2]
          \cdot [u, u^2, 1], \quad x = u / \ell

come from the first product, all smooth terms, and leverages by their Cholesky roots, along with
them; one exponential and one square later the second adds them up. For ``a_z(x)`` needs besides
each bump only that about zero, whose coefficient is minus the sum of all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration import kernel_features as features
from jointfit_daemon.calibration.kernel_expert import LARGEST, Expert

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.model import Vector

    Array = NDArray[np.float64]

_BENDS = 6
"""Smooth terms before u itself."""


@dataclass(frozen=True, slots=True)
class Tables:
    """Arrays for single frames."""

    terms: Array
    """Times [bends, u, u^2, 1] they are the exponents of all bumps, the roots of both leverages and
    the smooth part of both corrections, shape (bumps + p + q + 6, 2 width + 7)."""
    sums: Array
    """Times bumps, squares of the roots, and the smooth part they are both corrections and both
    leverages, shape (8, bumps + p + q + 6)."""
    bumps: int
    """How many of the terms are exponents."""
    roots: int
    """Where the roots end."""

    @staticmethod
    def of(plain: Expert, tilted: Expert, sensors: int) -> Tables:
        """Return the tables of two experts on a segment of so many sensors."""
        width = 3 * sensors + features.TILTS
        q = len(tilted.leverage)
        a, b = (_Part.of(expert, sensors, width, q) for expert in (plain, tilted))
        smooth = np.concatenate([a.root, b.root, a.of_smooth, b.of_smooth])
        bumps, terms = len(a.exponents) + len(b.exponents), len(smooth)
        table = np.zeros((bumps + terms, 2 * width + _BENDS + 1))
        table[:bumps, _BENDS:] = np.concatenate([a.exponents, b.exponents])
        table[bumps:, : smooth.shape[1]] = smooth
        table[-6:, -1] = (*a.rest, *b.rest)
        roots = bumps + terms - 6
        sums = np.zeros((8, len(table)))
        sums[:3, : len(a.exponents)] = a.of_bumps
        sums[3:6, len(a.exponents) : bumps] = b.of_bumps
        sums[:6, roots:] = np.eye(6)
        sums[6, bumps : bumps + len(a.root)] = 1.0
        sums[7, bumps + len(a.root) : roots] = 1.0
        return Tables(table, sums, bumps, roots)

    def correct(
        self, u: Sequence[float], tilts: Sequence[float]
    ) -> tuple[Vector, float, Vector, float]:
        """Return correction, rad, and leverage over its quantile: of the plain, of the tilted."""
        seen = [*u, *tilts]
        smooth = features.smooth_terms_one(seen)
        terms = self.terms.dot(np.array([*smooth, *[v * v for v in seen], 1.0]))
        bumps, roots = terms[: self.bumps], terms[self.bumps : self.roots]
        np.exp(bumps, bumps)
        np.multiply(roots, roots, roots)
        *c, plain, tilted = self.sums.dot(terms).tolist()
        if max(c) > LARGEST or min(c) < -LARGEST:
            c = [min(max(each, -LARGEST), LARGEST) for each in c]
        return (c[0], c[1], c[2]), plain, (c[3], c[4], c[5]), tilted


@dataclass(frozen=True, slots=True)
class _Part:
    """What one expert puts into the tables."""

    exponents: Array
    of_bumps: Array
    of_smooth: Array
    root: Array
    rest: tuple[float, ...]

    @staticmethod
    def of(expert: Expert, sensors: int, width: int, terms: int) -> _Part:
        """`width` columns of u and `terms` smooth terms are seen by whoever sees most."""
        scale = np.zeros(width)
        lengths = features.widths_of(expert.width, sensors, tilted=expert.tilted)
        scale[: len(lengths)] = 1.0 / lengths
        C = np.array(expert.coefficients)
        s = len(expert.leverage)
        centers = np.zeros((len(expert.centers) + 1, width))  # the last one is the static pose
        if expert.centers:
            centers[:-1, : len(lengths)] = np.array(expert.centers)
        half = 0.5 * np.sum(centers**2, axis=1)
        squares = np.tile(-0.5 * scale**2, (len(centers), 1))
        bumps = C[:, s:]
        smooth, root = np.zeros((3, terms)), np.zeros((s, terms))
        smooth[:, :s] = C[:, :s]
        root[:, :s] = np.linalg.cholesky(np.array(expert.leverage) / expert.hull_leverage).T
        return _Part(
            exponents=np.concatenate([centers * scale, squares, -half[:, None]], axis=1),
            of_bumps=np.concatenate([bumps, -bumps.sum(axis=1, keepdims=True)], axis=1),
            of_smooth=smooth,
            root=root,
            rest=tuple((bumps @ (1.0 - np.exp(-half[:-1]))).tolist()),
        )
