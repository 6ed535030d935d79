r"""Objective of a refinement: tracking errors and distance from the nominal positions.

With the markers' errors :math:`e_{tm} = R_{tm} p_m + t_{tm} - y_{tm}` and weights w,

.. math::

    F(q, p) = \sum_{tm} w_{tm}\, \rho(|e_{tm}|)
              + \tfrac12 \lambda \sum_m n_m\, |p_m - p^0_m|^2
              + \tfrac12 \kappa \sum_{tk} x_{tk}^2, \qquad n_m = \sum_t w_{tm}

where :math:`\rho` is the Huber loss: :math:`r^2/2`, and :math:`c (r - c/2)` beyond c. The prior
grows with the number of frames in which a marker is visible, so decimating frames does not change
the relative weight of the prior. Poses q are free in every frame, positions p are the same in all
frames. x is the excess of hinge angles over their limits, rad. Without this term, a program with
joint limits could not follow the refined markers.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics.chains import layout_of
from jointfit_daemon.kinematics.inverse_kinematics import limits_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel, ChainState
    from jointfit_daemon.kinematics.inverse_kinematics import Band


@dataclass(frozen=True)
class RefinementProblem:
    """Data of one refinement; without slots, because derived values are cached.

    The chain gives names, nominal positions and joints; measured positions beyond it are missing.
    """

    model: ChainModel
    targets: Array
    """Measured markers in the order of the model's, world, m, shape (T, M, 3); NaN: missing."""
    weights: Array
    """Weights of squared errors, shape (T, M); 0 where missing."""
    free: NDArray[np.bool_]
    """Coordinates that may move, shape (M, 3)."""
    prior: float
    """Weight lambda of the distances from the nominal positions."""
    huber_m: float | None
    """Error c above which the loss is linear, m; None: quadratic for all errors."""
    limit_m2: float = 0.0
    """Weight kappa of the excess of hinge angles, m²/rad²; 0: hinge angles are not limited."""

    @cached_property
    def seen(self) -> Array:
        """Measured markers with zeros for missing ones, shape (T, M, 3)."""
        return np.nan_to_num(self.targets)

    @cached_property
    def counts(self) -> Array:
        """Sum n_m of the weights of each marker, shape (M,)."""
        return np.asarray(self.weights.sum(axis=0))

    @cached_property
    def pull(self) -> Array:
        """Weight of the prior on every coordinate, shape (M, 3); zero for locked coordinates."""
        return self.prior * self.counts[:, None] * self.free

    @cached_property
    def limits(self) -> tuple[Band, ...]:
        """Limits of hinges in the objective."""
        return limits_of(self.model, self.limit_m2)

    def excess(self, state: ChainState) -> Array | None:
        """Return the excess of hinge angles over their limits, rad, (T, nq); None: no limits."""
        for band in self.limits:
            return np.where(band.weights > 0.0, band.excess(layout_of(self.model), state), 0.0)
        return None

    def overturning(self, state: ChainState) -> float:
        """Return the part of F caused by hinges beyond their limits."""
        excess = self.excess(state)
        return 0.0 if excess is None else float(0.5 * self.limit_m2 * (excess**2).sum())

    def robust(self, distances: Array) -> Array:
        """Return the weights of squared errors at these distances, shape (T, M)."""
        if self.huber_m is None:
            return self.weights
        beyond = np.maximum(distances, self.huber_m)
        return self.weights * (self.huber_m / beyond)

    def cost(self, distances: Array, positions: Array) -> float:
        """Return F from the distances |e|, m, shape (T, M)."""
        loss = 0.5 * distances**2
        if self.huber_m is not None:
            c = self.huber_m
            loss = np.where(distances > c, c * (distances - 0.5 * c), loss)
        away = positions - self.model.positions
        return float((self.weights * loss).sum() + 0.5 * (self.pull * away**2).sum())
