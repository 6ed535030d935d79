"""Slopes of measured values over a long run, with their 95 % intervals.

Neighbouring values depend on each other, so the line is fitted to the means of a few blocks, whose
lengths exceed that dependence. The first part of the run, in which caches fill, is left out.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

RESULTS = Path(__file__).parent / "results.json"
BLOCKS = 12
"""Number of means to which the line is fitted."""
WARM_UP = 0.25
"""Share of the run that is left out."""


@dataclass(frozen=True, slots=True)
class Slope:
    """A line through the values of a run."""

    per_million: float
    """Slope, units per million samples."""
    half_width: float
    """Half width of its 95 % interval."""
    mean: float

    @property
    def is_zero(self) -> bool:
        """Whether the interval contains zero."""
        return abs(self.per_million) <= self.half_width


def slope_of(samples: ArrayLike, values: ArrayLike) -> Slope:
    """Return the slope of values over the number of samples received.

    Raises
    ------
    ValueError
        Fewer values than two for each block.
    """
    x, y = np.asarray(samples, dtype=float) / 1e6, np.asarray(values, dtype=float)
    late = x >= x[0] + WARM_UP * (x[-1] - x[0])
    x, y = x[late], y[late]
    if len(x) < 2 * BLOCKS:
        raise ValueError(f"{len(x)} values after the warm-up, expected at least {2 * BLOCKS}")
    x, y = (np.array([part.mean() for part in np.array_split(axis, BLOCKS)]) for axis in (x, y))
    if np.ptp(y) == 0.0:
        return Slope(0.0, 0.0, float(y[0]))
    fit = stats.linregress(x, y)
    width = float(stats.t.ppf(0.975, BLOCKS - 2) * fit.stderr)
    return Slope(float(fit.slope), width, float(y.mean()))


def table_of(results: dict[str, Any]) -> str:
    """Return the slopes of a run as a table."""
    rows = ["| quantity | mean | slope per million samples, 95 % interval |", "| --- | --: | --: |"]
    for name, slope in results["slopes"].items():
        interval = f"{slope['per_million']:+.3g} ± {slope['half_width']:.2g}"
        rows.append(f"| {name} | {slope['mean']:.4g} | {interval} |")
    return "\n".join(rows)
