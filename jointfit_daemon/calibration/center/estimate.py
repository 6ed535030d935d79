"""One way in to every estimator of a center of rotation.

Law: a name, a movement, one `CenterEstimate`; what a method needs is said by `METHODS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.calibration.center.movement import Movement
    from jointfit_daemon.calibration.center.result import CenterEstimate

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Method:
    """One estimator by name."""

    name: str
    about: str
    """One line for people who choose."""
    needs: tuple[str, ...]
    """Fields of `Movement` that must be given: ``points``, ``parent`` and ``child``, ``angles``."""
    planar: bool
    """Works in a plane: points in space are projected along `Movement.axis`."""
    run: Callable[[Movement], CenterEstimate]


METHODS: dict[str, Method] = {}
"""``kasa pratt taubin hyper geometric running_circle oriented grid three_frames`` (plane),
``gamage_lasenby halvorsen sphere running_sphere score sara`` (space), by name."""


def estimate_center(movement: Movement | Array, method: str = "auto") -> CenterEstimate:
    """Estimate a center of rotation by any method.

    Parameters
    ----------
    movement : Movement or ndarray
        An array, shape (n, k, d) or (n, d), stands for `Movement` with these points only.
    method : str
        A key of `METHODS`, or ``auto``: ``sphere`` or, with both bodies' poses and no points,
        ``score``; in a plane ``hyper``.

    Returns
    -------
    CenterEstimate
        With `refused` set, naming cause and remedy, where the movement does not show a center.

    Raises
    ------
    ValueError
        Unknown method, or the movement lacks what it needs: wrong calls, not bad data.
    """
    raise NotImplementedError
