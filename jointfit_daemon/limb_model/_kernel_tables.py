r"""Precomputed arrays to evaluate two experts and the trend by two matrix products per frame.

The first product contains the exponents of all bumps, including the bump about zero,

.. math:: -\tfrac12 |x - z|^2 = [z / \ell, -\tfrac12 \ell^{-2}, -\tfrac12 |z|^2]
          \cdot [u, u^2, 1], \quad x = u / \ell

together with the smooth terms and the Cholesky roots of the leverages. The exponentials of the
exponents and the squares of the roots are the input of the second product, which sums them.
:math:`a_z(x)` needs each bump and the bump about zero, whose coefficient is minus the sum of all
other coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.arrays import Array  # noqa: TC001 - mypyc evaluates the types of fields
from jointfit_daemon.limb_model._kernel_expert import LARGEST, KernelExpert
from jointfit_daemon.limb_model._kernel_features import TILTS, smooth_terms_one, widths_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.model import Vector

_BENDS = 6
"""Number of smooth terms that precede the features u themselves."""


@dataclass(frozen=True, slots=True)
class KernelTables:
    """Arrays for the evaluation of single frames."""

    terms: Array
    """Matrix of the first product, shape (bumps + p + q + 8, 2 width + 7).

    The two experts have p and q smooth terms, and *width* is the number of regressors u. The
    product with [bends, u, u^2, 1] contains the exponents of all bumps, the roots of both
    leverages, the smooth parts of both corrections, and the trend. *Bends* are the smooth terms
    without u.
    """
    sums: Array
    """Matrix of the second product, shape (10, bumps + p + q + 8).

    The product with the bumps, squared roots, smooth parts and trend contains both corrections, the
    trend and both leverage ratios."""
    bumps: int
    """Number of exponents, which are the first elements of the product."""
    roots: int
    """Index after the last root in the product."""

    @staticmethod
    def of(
        plain: KernelExpert, tilted: KernelExpert, trend: Sequence[Sequence[float]]
    ) -> KernelTables:
        """Return the tables of two experts and the trend about x and y."""
        width = len(trend[0]) - 1
        sensors, q = (width - TILTS) // 3, len(tilted.leverage)
        a, b = (_Part.of(expert, sensors, width, q) for expert in (plain, tilted))

        # Each exponent, root, smooth part and trend component has one row.
        smooth = np.concatenate([a.root, b.root, a.of_smooth, b.of_smooth])
        bumps, roots = len(a.exponents) + len(b.exponents), len(a.root) + len(b.root)
        table = np.zeros((bumps + len(smooth) + 2, 2 * width + _BENDS + 1))
        table[:bumps, _BENDS:] = np.concatenate([a.exponents, b.exponents])
        table[bumps:-2, : smooth.shape[1]] = smooth
        table[-8:-2, -1] = (*a.rest, *b.rest)
        line = np.array(trend)
        table[-2:, -1], table[-2:, _BENDS : _BENDS + width] = line[:, 0], line[:, 1:]

        # The second product sums rows to the corrections of a and b, the trend and the leverages.
        sums = np.zeros((10, len(table)))
        sums[:3, : len(a.exponents)] = a.of_bumps
        sums[3:6, len(a.exponents) : bumps] = b.of_bumps
        sums[:8, bumps + roots :] = np.eye(8)
        sums[8, bumps : bumps + len(a.root)] = 1.0
        sums[9, bumps + len(a.root) : bumps + roots] = 1.0
        return KernelTables(table, sums, bumps, bumps + roots)

    def correct(
        self, u: Sequence[float], tilts: Sequence[float]
    ) -> tuple[Vector, float, Vector, float, tuple[float, float]]:
        """Return correction, rad, and leverage ratio of each expert, then the trend, rad.

        The plain expert precedes the tilted expert. The trend has the components x and y.
        """
        seen = [*u, *tilts]
        smooth = smooth_terms_one(seen)
        row = [*smooth, *[v * v for v in seen], 1.0]
        terms = self.terms.dot(np.array(row, np.float64))  # NumPy is faster if the type is given

        bumps, roots = terms[: self.bumps], terms[self.bumps : self.roots]
        np.exp(bumps, bumps)
        np.square(roots, roots)
        *c, plain, tilted = self.sums.dot(terms).tolist()

        if max(c) > LARGEST or min(c) < -LARGEST:
            c = [min(max(each, -LARGEST), LARGEST) for each in c]
        return (c[0], c[1], c[2]), plain, (c[3], c[4], c[5]), tilted, (c[6], c[7])


@dataclass(frozen=True, slots=True)
class _Part:
    """Contribution of one expert to the tables."""

    exponents: Array
    of_bumps: Array
    of_smooth: Array
    root: Array
    rest: tuple[float, ...]

    @staticmethod
    def of(expert: KernelExpert, sensors: int, width: int, terms: int) -> _Part:
        """Return the rows of one expert for `width` columns of u and `terms` smooth terms."""
        scale = np.zeros(width)
        lengths = widths_of(expert.width, sensors, tilted=expert.tilted)
        scale[: len(lengths)] = 1.0 / lengths
        C = np.array(expert.coefficients)
        s = len(expert.leverage)

        # The last center is zero. Every anchored bump subtracts the bump about zero.
        centers = np.zeros((len(expert.centers) + 1, width))
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
