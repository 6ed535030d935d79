r"""Objective of a refinement, from tracking errors and distances from the nominal positions.

In frame t, marker m has the error :math:`e_{tm} = R_{tm} p_m + t_{tm} - y_{tm}` and the weight w.
Here p is the position on the segment, R and t the pose of the segment, and y the measured position.
The objective is

.. math::

    F(q, p) = \sum_{tm} w_{tm}\, \rho(|e_{tm}|)
              + \tfrac12 \lambda \sum_m n_m\, |p_m - p^0_m|^2
              + \tfrac12 \kappa \sum_{tk} x_{tk}^2, \qquad n_m = \sum_t w_{tm}

where :math:`\rho` is the Huber loss, :math:`r^2/2` up to the distance c and :math:`c (r - c/2)`
beyond. The weight of the prior grows with the number of frames in which a marker is visible.
Decimating frames therefore does not change the relative weight of the prior. Poses q are free in
every frame, and positions p are the same in all frames. x is the excess of hinge angles over their
limits, rad. Without the last term, a program with joint limits could not track the refined markers.
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
    """Data of one refinement. The class has no slots, because derived values are cached.

    The model contains names, nominal positions and joints. Measured positions are in `targets`.
    """

    model: ChainModel
    targets: Array
    """Measured positions in T frames, world, in the order of the model's M markers, m, shape
    (T, M, 3); NaN where missing.
    """
    weights: Array
    """Weights of squared errors, shape (T, M); 0 where missing."""
    free: NDArray[np.bool_]
    """Coordinates that may move, shape (M, 3)."""
    prior: float
    """Weight lambda of the distances from the nominal positions."""
    huber_m: float | None
    """Error c above which the loss is linear, m; None if the loss is quadratic for all errors."""
    limit_m2: float = 0.0
    """Weight kappa of the squared excess of hinge angles, m²/rad²; 0 if angles are not limited."""

    @cached_property
    def seen(self) -> Array:
        """Measured positions with zeros for missing markers, shape (T, M, 3)."""
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
        """Angle limits of the hinges that are part of the objective."""
        return limits_of(self.model, self.limit_m2)

    def excess(self, state: ChainState) -> Array | None:
        """Return the excess of hinge angles over their limits, rad; None without limits.

        The shape is (T, nq) for nq degrees of freedom.
        """
        for band in self.limits:
            return np.where(band.weights > 0.0, band.excess(layout_of(self.model), state), 0.0)
        return None

    def overturning(self, state: ChainState) -> float:
        """Return the term of F for hinges beyond their limits."""
        excess = self.excess(state)
        return 0.0 if excess is None else float(0.5 * self.limit_m2 * (excess**2).sum())

    def robust(self, distances: Array) -> Array:
        """Return the weights of squared errors at these distances, shape (T, M)."""
        if self.huber_m is None:
            return self.weights
        beyond = np.maximum(distances, self.huber_m)
        return self.weights * (self.huber_m / beyond)

    def cost(self, distances: Array, positions: Array) -> float:
        """Return F without its last term, from the distances |e|, m, shape (T, M)."""
        loss = 0.5 * distances**2
        if self.huber_m is not None:
            c = self.huber_m
            loss = np.where(distances > c, c * (distances - 0.5 * c), loss)
        away = positions - self.model.positions
        return float((self.weights * loss).sum() + 0.5 * (self.pull * away**2).sum())
