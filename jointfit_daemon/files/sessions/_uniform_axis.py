"""Series on one uniform time axis, for formats that have a single rate.

If the instants of a series lie on the axis, its rows are used unchanged, and missing rows become
unknown values. Other series are interpolated: values linearly, orientations along the shortest
rotation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.session_data import (
    interpolate_orientations,
    interpolate_values,
    rows_on_axis,
    sample_rate_hz,
    uniform_times,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array


class UniformAxis:
    """A uniform time axis, and the names of the series that were interpolated to it.

    Parameters
    ----------
    axes
        Times of all series, s.
    """

    def __init__(self, axes: Sequence[Array]) -> None:
        self.t_s = uniform_times(axes)
        rate_hz = sample_rate_hz(self.t_s)
        self.rate_hz = rate_hz if np.isfinite(rate_hz) else 1.0
        self.resampled: list[str] = []

    def orientations(self, name: str, t_s: Array, q: Array) -> Array:
        """Return orientations of shape (n, 4), one per instant of the axis; NaN where unknown."""
        if not len(t_s):
            return self._empty((4,))
        if self._take(name, t_s):
            return interpolate_orientations(t_s, q, self.t_s)
        return self._place_rows(t_s, q)

    def values(self, name: str, t_s: Array, values: Array) -> Array:
        """Return values of shape (n, ...), one per instant of the axis; NaN where unknown."""
        if not len(t_s):
            return self._empty(values.shape[1:])
        if self._take(name, t_s):
            return interpolate_values(t_s, values, self.t_s)
        return self._place_rows(t_s, values)

    def note(self, file: str) -> list[str]:
        """Return a list with a note that names the interpolated series; empty if there are none."""
        if not self.resampled:
            return []
        names = ", ".join(self.resampled)
        return [f"{file}: resampled to {self.rate_hz:.6g} Hz by interpolation: {names}"]

    def _take(self, name: str, t_s: Array) -> bool:
        """Return whether a series needs interpolation; store its name for the note."""
        if rows_on_axis(t_s, self.t_s) is not None:
            return False
        if name not in self.resampled:
            self.resampled.append(name)
        return True

    def _place_rows(self, t_s: Array, values: Array) -> Array:
        placed = self._empty(values.shape[1:])
        placed[rows_on_axis(t_s, self.t_s)] = values
        return placed

    def _empty(self, shape: tuple[int, ...]) -> Array:
        return np.full((len(self.t_s), *shape), np.nan)
