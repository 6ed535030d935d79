r"""Anderson acceleration of a fixed-point iteration p = g(p); the caller accepts each proposal.

The caller must accept a proposal only if the proposal lowers the objective. Without this condition
the acceleration increased tracking errors.

.. math::

    f_k = g(p_k) - p_k, \quad \gamma = \arg\min |f_k - \Delta F \gamma|, \quad
    p = g(p_k) - \Delta G \gamma

where the columns of :math:`\Delta F` and :math:`\Delta G` are the differences of f and g between
the last iterations. Source: Anderson, J. ACM 12 (1965), 547; Walker and Ni, SIAM J. Numer. Anal. 49
(2011), 1715.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

DEPTH = 4
"""Number of iterations in the history."""
_RANK = 1e-8


class Anderson:
    """Proposes the next point of the iteration from the last points p and their images g(p)."""

    def __init__(self) -> None:
        self._images: list[Array] = []
        self._changes: list[Array] = []

    def propose(self, at: Array, image: Array) -> Array | None:
        """Return the next point to try after g(`at`) = `image`; None without a history."""
        self._images = [*self._images[-DEPTH:], image]
        self._changes = [*self._changes[-DEPTH:], image - at]
        if len(self._images) == 1:
            return None
        dG = np.diff(np.array(self._images), axis=0).T
        dF = np.diff(np.array(self._changes), axis=0).T
        gamma = np.linalg.lstsq(dF, self._changes[-1], rcond=_RANK)[0]
        return np.asarray(image - dG @ gamma)

    def forget(self) -> None:
        """Discard the history after a rejected proposal."""
        self._images.clear()
        self._changes.clear()
