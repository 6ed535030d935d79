r"""Two experts and the trend as the frame loop wants them: one frame in two matrix products.

All exponents of the bumps of both, of that about zero among them,

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

from jointfit_daemon.limb_model._kernel_expert import LARGEST, Expert
from jointfit_daemon.limb_model._kernel_features import TILTS, smooth_terms_one, widths_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Vector

_BENDS = 6
"""Smooth terms before u itself."""


@dataclass(frozen=True, slots=True)
class Tables:
    """Arrays for single frames."""

    terms: Array
    """Times [bends, u, u^2, 1] they are the exponents of all bumps, the roots of both leverages,
    smooth parts of both corrections and the trend, shape (bumps + p + q + 8, 2 width + 7)."""
    sums: Array
    """Times bumps, squares of the roots, smooth parts and trend they are both corrections, the
    trend and both leverages, shape (10, bumps + p + q + 8)."""
    bumps: int
    """How many of the terms are exponents."""
    roots: int
    """Where the roots end."""

    @staticmethod
    def of(plain: Expert, tilted: Expert, trend: Sequence[Sequence[float]]) -> Tables:
        """Return the tables of two experts and the trend about x and y."""
        width = len(trend[0]) - 1
        sensors, q = (width - TILTS) // 3, len(tilted.leverage)
        a, b = (_Part.of(expert, sensors, width, q) for expert in (plain, tilted))
        smooth = np.concatenate([a.root, b.root, a.of_smooth, b.of_smooth])
        bumps, roots = len(a.exponents) + len(b.exponents), len(a.root) + len(b.root)
        table = np.zeros((bumps + len(smooth) + 2, 2 * width + _BENDS + 1))
        table[:bumps, _BENDS:] = np.concatenate([a.exponents, b.exponents])
        table[bumps:-2, : smooth.shape[1]] = smooth
        table[-8:-2, -1] = (*a.rest, *b.rest)
        line = np.array(trend)
        table[-2:, -1], table[-2:, _BENDS : _BENDS + width] = line[:, 0], line[:, 1:]
        sums = np.zeros((10, len(table)))
        sums[:3, : len(a.exponents)] = a.of_bumps
        sums[3:6, len(a.exponents) : bumps] = b.of_bumps
        sums[:8, bumps + roots :] = np.eye(8)
        sums[8, bumps : bumps + len(a.root)] = 1.0
        sums[9, bumps + len(a.root) : bumps + roots] = 1.0
        return Tables(table, sums, bumps, bumps + roots)

    def correct(
        self, u: Sequence[float], tilts: Sequence[float]
    ) -> tuple[Vector, float, Vector, float, tuple[float, float]]:
        """Return correction, rad, and leverage ratio, of a and of b; then T_x and T_y, rad."""
        seen = [*u, *tilts]
        smooth = smooth_terms_one(seen)
        row = [*smooth, *[v * v for v in seen], 1.0]
        terms = self.terms.dot(np.array(row, np.float64))  # told the type, numpy need not look
        bumps, roots = terms[: self.bumps], terms[self.bumps : self.roots]
        np.exp(bumps, bumps)
        np.square(roots, roots)
        *c, plain, tilted = self.sums.dot(terms).tolist()
        if max(c) > LARGEST or min(c) < -LARGEST:
            c = [min(max(each, -LARGEST), LARGEST) for each in c]
        return (c[0], c[1], c[2]), plain, (c[3], c[4], c[5]), tilted, (c[6], c[7])


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
        lengths = widths_of(expert.width, sensors, tilted=expert.tilted)
        scale[: len(lengths)] = 1.0 / lengths
        C = np.array(expert.coefficients)
        s = len(expert.leverage)
        centers = np.zeros((len(expert.centers) + 1, width))  # the last one is zero
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
