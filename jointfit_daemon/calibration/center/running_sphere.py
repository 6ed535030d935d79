"""The center that several markers turn about, one frame at a time, at constant cost.

Law: a frame costs the same whether it is the first or the millionth; the answer equals that of all
frames at once with the same weights.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from jointfit_daemon.calibration.center.result import CenterEstimate

Array = NDArray[np.float64]


class RunningSphere:
    """Center of rotation of several markers, fed frame by frame.

    Parameters
    ----------
    markers : int
        How many markers a frame has, k.
    forgetting : float
        What is left of a frame's weight one frame later, in (0, 1]; 1 keeps all.
    dimension : int
        3, or 2 for points in a plane.
    near : ndarray, shape (dimension,), optional
        Where to stay along directions the movement does not show, m.
    robust : bool
        Weigh down markers that leave the sphere found so far, as skin and swapped names do.
    """

    def __init__(
        self,
        markers: int,
        *,
        forgetting: float = 1.0,
        dimension: int = 3,
        near: Array | None = None,
        robust: bool = True,
    ) -> None:
        raise NotImplementedError

    def feed(self, points: Array, weights: Array | None = None) -> None:
        """Take one frame, m, shape (k, d), in the parent's coordinates; NaN where not seen."""
        raise NotImplementedError

    def estimate(self) -> CenterEstimate:
        """Return center, covariance and predicted error of all frames so far; never raises.

        Costs more than `feed`: ask when it is to be published, not every frame.
        """
        raise NotImplementedError
