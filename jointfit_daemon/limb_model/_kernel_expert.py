r"""One correction by kernel ridge: width and penalties by held-out groups.

.. math:: c(u) = \mathrm{clip}(C^T [s(u), a_{z_1}(u / \ell) \dots a_{z_m}(u / \ell)])

with smooth terms s and anchored bumps a of `kernel_features`. Law: an expert only says what it has
learned and how far outside its training a frame lies; what is made of it is the model's affair.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.limb_model._kernel_features import bumps, smooth_terms, widths_of

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from jointfit_daemon.arrays import Array

    Rows = tuple[tuple[float, ...], ...]

LARGEST = 0.4
"""No component of a correction exceeds this, rad."""


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
            coefficients=as_rows(data["coefficients"]),
            centers=as_rows(data["centers"]),
            leverage=as_rows(data["leverage"]),
            hull_leverage=data["hull_leverage"],
            carried=tuple(data["carried"]),
        )


def as_rows(rows: Iterable[Iterable[float]]) -> Rows:
    return tuple(tuple(row) for row in rows)
