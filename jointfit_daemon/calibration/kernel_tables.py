r"""Two experts as the frame loop wants them: everything of one frame in three matrix products.

All bumps of both, and the static pose's own, come from one product and one exponential,

.. math:: -\tfrac12 |x - z|^2 = [z / \ell, -\tfrac12 \ell^{-2}, -\tfrac12 |z|^2]
          \cdot [u, u^2, 1], \quad x = u / \ell

since ``a_z(x)`` needs besides each bump only that about zero, whose coefficient is minus the sum of
all. All smooth terms and both leverages come from another, leverages by their Cholesky roots.
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


@dataclass(frozen=True, slots=True)
class Tables:
    """Arrays for single frames."""

    exponents: Array
    """Times [u, u^2, 1] they are the exponents of all bumps, shape (bumps, 2 width + 1)."""
    of_bumps: Array
    """Coefficients of both experts, shape (6, bumps)."""
    of_smooth: Array
    """Coefficients of both, then roots of their leverages, shape (6 + p + q, q)."""
    rest: tuple[float, ...]
    """What the constants of the bumps add, six numbers."""
    first: int
    """Where the root of the second expert begins."""

    @staticmethod
    def of(plain: Expert, tilted: Expert, sensors: int) -> Tables:
        """Return the tables of two experts on a segment of so many sensors."""
        width = 3 * sensors + features.TILTS
        p, q = len(plain.leverage), len(tilted.leverage)
        parts = [_Part.of(expert, sensors, width, q) for expert in (plain, tilted)]
        a, b = parts
        none_a, none_b = np.zeros_like(a.of_bumps), np.zeros_like(b.of_bumps)
        return Tables(
            exponents=np.concatenate([a.exponents, b.exponents]),
            of_bumps=np.block([[a.of_bumps, none_b], [none_a, b.of_bumps]]),
            of_smooth=np.concatenate([a.of_smooth, b.of_smooth, a.root, b.root]),
            rest=(*a.rest, *b.rest),
            first=6 + p,
        )

    def correct(
        self, u: Sequence[float], tilts: Sequence[float]
    ) -> tuple[Vector, float, Vector, float]:
        """Return correction, rad, and leverage over its quantile: of the plain, of the tilted."""
        seen = [*u, *tilts]
        bumps = np.exp(self.exponents @ np.array([*seen, *[v * v for v in seen], 1.0]))
        near = (self.of_bumps @ bumps).tolist()
        smooth = (self.of_smooth @ np.array(features.smooth_terms_one(seen))).tolist()
        c = [n + s + r for n, s, r in zip(near, smooth, self.rest, strict=False)]
        if max(c) > LARGEST or min(c) < -LARGEST:
            c = [min(max(each, -LARGEST), LARGEST) for each in c]
        plain = sum([far * far for far in smooth[6 : self.first]])
        tilted = sum([far * far for far in smooth[self.first :]])
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
