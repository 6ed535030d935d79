r"""One soft-tissue correction by kernel ridge regression.

.. math:: c(u) = \mathrm{clip}(C^T [s(u), a_{z_1}(u / \ell) \dots a_{z_m}(u / \ell)])

where u are the regressors, s the smooth terms and a the anchored bumps of `_kernel_features`. C are
the coefficients, z the centers of the bumps, and :math:`\ell` is the kernel width. An expert
returns its correction and the leverage of the frame. `KernelModel` combines two experts.
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
"""Limit of each component of a correction, rad."""


@dataclass(frozen=True, slots=True)
class KernelExpert:
    """Fitted correction of one segment."""

    width: float
    """Kernel width, rad."""
    tilted: bool
    """Whether the tilt of the segment is one of the regressors."""
    coefficients: Rows
    """Matrix C^T with three rows, rad per unit of each smooth term and bump."""
    centers: Rows
    """Centers of the bumps, in kernel widths."""
    leverage: Rows
    """Square matrix H: ``s @ H @ s`` is the leverage of a frame with smooth terms s."""
    hull_leverage: float
    """0.995 quantile of the leverage over the training frames."""
    carried: tuple[float, ...]
    """Sum of the weights with which the fits of all ridge penalties are combined (stacking), for
    each axis, shape (3,). It is the fraction of the correction that generalizes to held-out frames.
    """

    def correct(self, u: Array, sensors: int) -> tuple[Array, Array]:
        """Return the correction, rad, shape (n, 3), and the leverage ratio, shape (n,).

        The leverage ratio is the leverage of a frame divided by the 0.995 quantile of the leverages
        in training.

        Parameters
        ----------
        u : ndarray, shape (n, 3 m + 3)
            Joint rotation and sensor disagreements (3 m columns), then tilts (3 columns), as
            returned by `model_inputs`, rad.
        sensors : int
            Number of sensors m.
        """
        seen = u if self.tilted else u[:, : 3 * sensors]
        smooth = smooth_terms(seen)
        x = seen / widths_of(self.width, sensors, tilted=self.tilted)
        centers = np.array(self.centers, dtype=np.float64).reshape(-1, x.shape[1])
        phi = np.concatenate([smooth, bumps(x, centers)], axis=1)
        far = np.einsum("ij,jk,ik->i", smooth, np.array(self.leverage), smooth)
        correction = np.clip(phi @ np.array(self.coefficients).T, -LARGEST, LARGEST)
        return correction, far / self.hull_leverage

    @staticmethod
    def read(data: Mapping[str, Any]) -> KernelExpert:
        """Return the expert from its JSON form."""
        return KernelExpert(
            width=data["width"],
            tilted=data["tilted"],
            coefficients=as_rows(data["coefficients"]),
            centers=as_rows(data["centers"]),
            leverage=as_rows(data["leverage"]),
            hull_leverage=data["hull_leverage"],
            carried=tuple(data["carried"]),
        )


def as_rows(rows: Iterable[Iterable[float]]) -> Rows:
    """Return nested numbers as a tuple of tuples."""
    return tuple(tuple(row) for row in rows)
