r"""Where a chain must be so that its markers lie nearest to the measured ones.

Law: at every instant

.. math:: q_t = \arg\min_q \sum_m w_{tm} |x_m(q) - y_{tm}|^2

by Levenberg and Marquardt, all instants at once, each with its own damping. A marker that is NaN
weighs nothing. What the markers leave open is told, and held to the instant before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from jointfit_daemon.kinematics.chain_model import Array, ChainModel
    from jointfit_daemon.kinematics.chain_motion import ChainState


@dataclass(frozen=True, slots=True)
class IkOptions:
    """How to search; the defaults are for markers on skin."""

    iterations: int = 60
    """At most, per instant and weighting."""
    tolerance: float = 1e-7
    """Relative decrease of the squared error at which an instant is done."""
    huber_m: float | None = None
    """Errors beyond weigh as c/|e|, m; None: plain least squares."""
    reweightings: int = 2
    """Rounds of new robust weights."""
    hold_m2: float = 1e-4
    """Weight, m^2/rad^2, of a joint's turn since the instant before, if markers leave one open."""
    limit_m2: float = 0.0
    """Weight, m^2/rad^2, of a hinge's excess over its limits; 0: limits are not looked at."""


@dataclass(frozen=True, slots=True)
class IkResult:
    """Poses at T instants and how well they fit; S segments, M markers."""

    state: ChainState
    rotations: Array
    """R_world_segment, shape (T, S, 3, 3)."""
    origins: Array
    """World origins of the segments, m, shape (T, S, 3)."""
    residuals: Array
    """Marker of the model minus measured, m, shape (T, M, 3); NaN where none was measured."""
    weights: Array
    """As used in the end, shape (T, M): 0 where missing, robust factors included."""
    converged: NDArray[np.bool_]
    """Shape (T,)."""
    underdetermined: NDArray[np.bool_]
    """The markers left some degree of freedom open, which was held; shape (T,)."""
    iterations: NDArray[np.intp]
    """Shape (T,)."""


def solve_frames(
    model: ChainModel,
    markers: ArrayLike,
    weights: ArrayLike | None = None,
    *,
    start: ChainState | None = None,
    options: IkOptions | None = None,
) -> IkResult:
    """Return the poses that bring the model's markers nearest to the measured ones.

    Parameters
    ----------
    model
        Of S segments and M markers.
    markers : array_like, shape (T, M, 3)
        Measured, in the order of ``model.markers``, world, m; NaN where missing.
    weights : array_like, shape (M,) or (T, M), optional
        Of squared errors; the model's own if None.
    start
        Where to begin at each instant, length T; from the markers themselves if None.
    options
        `IkOptions()` if None.

    Raises
    ------
    ValueError
        Shapes that do not belong together, negative weights.
    """
    raise NotImplementedError


def tracking_error(residuals: Array) -> float:
    """Return the root of the mean squared distance over all markers present, m; NaN if none is."""
    square = np.einsum("...i,...i->...", residuals, residuals)
    seen = np.isfinite(square)
    return float(np.sqrt(square[seen].mean())) if seen.any() else float("nan")
