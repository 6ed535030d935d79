r"""Coordinate search of Price et al. (2020): one marker coordinate at a time is changed.

The search needs only the tracking error of inverse kinematics for a set of marker positions. It can
therefore be used with any model, including a model in another program. Every unlocked coordinate
has a separate step length::

    while any step is at or above the threshold:
        for every marker coordinate (x, y or z) with a step at or above the threshold:
            move the coordinate by +step while the error decreases
            if it was not moved: move the coordinate by -step while the error decreases
            if it was not moved: halve the step

Source: Price, LaPrè, Johnson, Umberger and Sup, Int J Numer Method Biomed Eng 36 (2020) e3283, doi
10.1002/cnm.3283. The paper does not state the first step, the threshold, the order of the
coordinates or the least decrease.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array


@dataclass(frozen=True, slots=True)
class SearchSettings:
    """Parameters that the source does not state."""

    first_step_m: float = 0.008
    """Step of every coordinate at the start, m."""
    threshold_m: float = 0.002
    """A coordinate is complete when its step is below this threshold, m."""
    least_gain_m: float = 1e-7
    """Least decrease of the error with which a step is accepted, m."""


@dataclass(frozen=True, slots=True)
class SearchResult:
    """Result of the search."""

    positions: Array
    """Positions of the M markers on their segments, m, shape (M, 3)."""
    errors: tuple[float, ...]
    """RMS tracking error at the start and after every accepted step, m."""
    runs: int
    """Number of runs of inverse kinematics."""
    complete: bool = True
    """Whether every step is below the threshold."""


def search(
    tracking_error: Callable[[Array], float],
    start: Array,
    free: NDArray[np.bool_],
    settings: SearchSettings = SearchSettings(),
    progress: Callable[[float, float], None] | None = None,
    *,
    stop: Callable[[], bool] = lambda: False,
) -> SearchResult:
    """Refine marker positions coordinate by coordinate.

    Parameters
    ----------
    tracking_error
        Function that returns the RMS distance between measured and model markers after inverse
        kinematics, m. The inverse kinematics may start from the poses of the last call.
    start
        Positions of the M markers on their segments, m, shape (M, 3).
    free
        False where a coordinate is locked, shape (M, 3).
    settings
        First step, threshold and least decrease of the error.
    progress
        Function that is called after every pass with the largest remaining step and the error, both
        m.
    stop
        Function that is called before every coordinate. If it returns true, the search ends.
    """
    walk = _Walk(tracking_error, start)
    steps = np.where(free, settings.first_step_m, 0.0)
    while (steps >= settings.threshold_m).any():
        for marker, axis in np.argwhere(steps >= settings.threshold_m):
            if stop():
                return SearchResult(walk.positions, tuple(walk.errors), walk.runs, complete=False)
            if not walk.along(marker, axis, steps[marker, axis], settings.least_gain_m):
                steps[marker, axis] /= 2.0

        if progress is not None:
            progress(float(steps.max()), walk.errors[-1])

    return SearchResult(walk.positions, tuple(walk.errors), walk.runs)


class _Walk:
    """Current marker positions and their tracking errors."""

    def __init__(self, tracking_error: Callable[[Array], float], start: Array) -> None:
        self._tracking_error = tracking_error
        self.positions = np.array(start, dtype=np.float64)
        self.runs = 0
        self.errors = [self._measure(self.positions)]

    def _measure(self, positions: Array) -> float:
        self.runs += 1
        return self._tracking_error(positions)

    def along(self, marker: int, axis: int, step: float, least_gain: float) -> bool:
        """Step forward, else backward, while the error decreases; return whether it decreased."""
        accepted = len(self.errors)
        for signed in (step, -step):
            while True:
                trial = self.positions.copy()
                trial[marker, axis] += signed
                error = self._measure(trial)
                if not error < self.errors[-1] - least_gain:
                    break

                self.positions = trial
                self.errors.append(error)
            if len(self.errors) > accepted:
                return True
        return False
