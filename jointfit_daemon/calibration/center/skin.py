"""Centers through skin that moves, of joints that roll.

Law: what repeats with posture no number of frames averages away, so its size is added as told; a
center that moves is followed only where it has moved beyond doubt.
"""

from __future__ import annotations

from dataclasses import replace
from math import exp
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.center.running_sphere import RunningSphere

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.center.result import CenterEstimate
    from jointfit_daemon.calibration.center.sphere_directions import Limits


SKIN_SD_M = 0.010
"""Of a center through the skin of a leg: markers leave the bone by 5 to 50 mm."""
MOVED = 3.0
"""Combined standard errors by which a recent center must differ to be believed."""
CYCLES = 2.0
"""Movements the memory must hold."""


def with_skin(estimate: CenterEstimate, sd: float = SKIN_SD_M) -> CenterEstimate:
    """Add what skin does to the covariance of the directions seen.

    Parameters
    ----------
    estimate : CenterEstimate
        From marker noise alone.
    sd : float
        Standard deviation per direction, m.
    """
    across = np.eye(len(estimate.center)) - estimate.unseen.T @ estimate.unseen
    return replace(
        estimate,
        covariance=estimate.covariance + sd**2 * across,
        flags=(*estimate.flags, "skin_added"),
    )


class RollingCenter:
    """Center of a joint that may roll, as a knee does: the long-term one and a recent one.

    Parameters
    ----------
    markers : int
        How many markers a frame has.
    interval : float
        From frame to frame, s.
    cycle : float
        How long one movement takes, s; the recent center remembers `CYCLES` of them,
        μ = exp(-Δt/τ).
    limits : Limits, optional
        When to refuse.

    Raises
    ------
    ValueError
        Interval or cycle not above zero.
    """

    def __init__(
        self, markers: int, *, interval: float, cycle: float, limits: Limits | None = None
    ) -> None:
        if not interval > 0.0 or not cycle > interval:
            raise ValueError(f"interval {interval} s, cycle {cycle} s: 0 < interval < cycle needed")
        self._long = RunningSphere(markers, limits=limits)
        memory = exp(-interval / (CYCLES * cycle))
        self._recent = RunningSphere(markers, forgetting=memory, limits=limits)

    def feed(self, points: Array) -> None:
        """Take one frame, m, shape (k, 3); NaN where not seen."""
        self._long.feed(points)
        self._recent.feed(points)

    def estimate(self) -> CenterEstimate:
        """Return the long-term center, or the recent one flagged ``center_moves``."""
        whole, recent = self._long.estimate(), self._recent.estimate()
        if whole.refused is not None or recent.refused is not None:
            return whole
        gap = _in_common(whole, recent) @ (recent.center - whole.center)
        P = _in_common(whole, recent)
        spread = P @ (whole.covariance + recent.covariance) @ P.T
        if len(P) == 0 or float(gap @ np.linalg.solve(spread, gap)) <= MOVED**2 * len(gap):
            return whole
        return replace(recent, flags=(*recent.flags, "center_moves"))


def _in_common(a: CenterEstimate, b: CenterEstimate) -> Array:
    """Return the directions that both saw, the rows."""
    unseen = np.concatenate((a.unseen, b.unseen))
    if len(unseen) == 0:
        return np.eye(len(a.center))
    _, s, Vt = np.linalg.svd(unseen, full_matrices=True)
    # axes of one hinge that differ by their own errors are one direction
    return np.asarray(Vt[int(np.count_nonzero(s > 0.2)) :])
