r"""One correction by kernel ridge: width and penalties by held-out groups.

.. math:: c(u) = \mathrm{clip}(C^T [s(u), a_{z_1}(u / \ell) \dots a_{z_m}(u / \ell)])

with smooth terms s and anchored bumps a of `kernel_features`. Law: an expert only says what it has
learned and how far outside its training a frame lies; what is made of it is the model's affair.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jointfit_daemon.calibration.held_out_spread import SMALLEST_LEVERAGE, hull, ratios
from jointfit_daemon.calibration.kernel_features import (
    WIDTHS,
    bumps,
    smooth_terms,
    spread_centers,
    widths_of,
)
from jointfit_daemon.calibration.kernel_ridge import Basis, choose, fit

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

    Ways = Sequence[Sequence[NDArray[np.bool_]]]
    Rows = tuple[tuple[float, ...], ...]

LARGEST = 0.4
"""No component of a correction exceeds this, rad."""
HULL_QUANTILE = 0.995


@dataclass(frozen=True, slots=True)
class Expert:
    """A fitted correction of one segment."""

    width: float
    """Chosen among ``WIDTHS``, rad."""
    tilted: bool
    """It looks at the tilt of the segment, too."""
    coefficients: Rows
    """C^T: three rows, rad per unit of each smooth term and bump."""
    centers: Rows
    """Of the bumps, in widths."""
    leverage: Rows
    """Square: ``s @ leverage @ s`` of smooth terms s: how far a frame lies outside training."""
    hull_leverage: float
    """0.995 quantile of the leverage over training."""
    carried: tuple[float, ...]
    """Sum of shares by axis: how much of what was learned carries over to unseen frames."""

    def correct(self, u: Array, sensors: int) -> tuple[Array, Array]:
        """Return the correction, rad, shape (n, 3), and leverage over its quantile, shape (n,).

        Parameters
        ----------
        u : ndarray, shape (n, 3 m + 3)
            Relative rotations of m sensors, then tilts.
        sensors : int
            m.
        """
        seen = u if self.tilted else u[:, : 3 * sensors]
        smooth = smooth_terms(seen)
        x = seen / widths_of(self.width, sensors, tilted=self.tilted)
        centers = np.array(self.centers, dtype=np.float64).reshape(-1, x.shape[1])
        phi = np.concatenate([smooth, bumps(x, centers)], axis=1)
        far = np.einsum("ij,jk,ik->i", smooth, np.array(self.leverage), smooth)
        correction = np.clip(phi @ np.array(self.coefficients).T, -LARGEST, LARGEST)
        return correction, far / self.hull_leverage

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON form."""
        return {
            "width": self.width,
            "tilted": self.tilted,
            "coefficients": [list(row) for row in self.coefficients],
            "centers": [list(row) for row in self.centers],
            "leverage": [list(row) for row in self.leverage],
            "hull_leverage": self.hull_leverage,
            "carried": list(self.carried),
        }

    @staticmethod
    def read(data: Mapping[str, Any]) -> Expert:
        """Return the expert of its JSON form."""
        return Expert(
            width=data["width"],
            tilted=data["tilted"],
            coefficients=_rows(data["coefficients"]),
            centers=_rows(data["centers"]),
            leverage=_rows(data["leverage"]),
            hull_leverage=data["hull_leverage"],
            carried=tuple(data["carried"]),
        )


class Fitted(NamedTuple):
    """An expert, and what it had said of frames it had not seen."""

    expert: Expert
    unseen: tuple[Array, ...]
    """By way of leaving out: its corrections of held-out frames, rad, shape (n, 3)."""
    ratios: tuple[Array, ...]
    """By way: how far each frame lay outside the others, shape (n,)."""


def fit_expert(u: Array, rho: Array, sensors: int, ways: Ways, *, tilted: bool) -> Fitted:
    """Fit one expert; the width is the one of the smallest squared error on held-out groups.

    Penalties are stacked once for every way of leaving out, and the fits by these shares averaged:
    whole trials ask what carries over to another movement, blocks what does within one.

    Parameters
    ----------
    u : ndarray, shape (n, 3 m + 3)
        Relative rotations, then tilts.
    rho : ndarray, shape (n, 3)
        What is to be corrected, rad.
    ways : sequence of sequence of ndarray of bool, shape (n,)
        Ways of leaving out, each with its groups.
    """
    seen = u if tilted else u[:, : 3 * sensors]
    smooth = smooth_terms(seen)
    best = None
    for width in WIDTHS:
        x = seen / widths_of(width, sensors, tilted=tilted)
        centers = spread_centers(x)
        basis = Basis.of(smooth, bumps(x, centers), bumps(centers, centers))
        held = [choose(basis, rho, groups) for groups in ways]
        score = sum(float(np.sum(each.residuals**2)) for each in held)
        if best is None or score < best[0]:
            best = (score, width, centers, basis, held)
    if best is None:
        raise ValueError("no width to choose")
    _, width, centers, basis, held = best
    C = np.mean([fit(basis, rho, each.shares) for each in held], axis=0)
    leverage = hull(smooth)
    h = np.einsum("ij,jk,ik->i", smooth, leverage, smooth)
    expert = Expert(
        width=width,
        tilted=tilted,
        coefficients=_rows(C.T.tolist()),
        centers=_rows(centers.tolist()),
        leverage=_rows(leverage.tolist()),
        hull_leverage=max(float(np.quantile(h, HULL_QUANTILE)), SMALLEST_LEVERAGE),
        carried=tuple(held[-1].shares.sum(axis=(1, 2)).tolist()),
    )
    unseen = tuple(rho - each.residuals for each in held)
    return Fitted(expert, unseen, tuple(ratios(smooth, groups) for groups in ways))


def _rows(rows: Iterable[Iterable[float]]) -> Rows:
    return tuple(tuple(row) for row in rows)
