"""Slopes of measured values over a long run, with their intervals of 95 % joint confidence.

Neighbouring values depend on each other, so the line is fitted to the lower quartiles of a few
blocks, which are longer than this dependence. A leak or a backlog of the daemon increases all
values of a block; another program of this machine increases some values. The first part of the run,
in which caches fill, is left out.

A value *has a slope* if the interval of its slope does not contain zero. Invariant: of twenty runs
without growth, about one has a slope in any of its quantities.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

RESULTS = Path(__file__).parent / "results.json"
ERROR = "median error of poses, deg"
MOST_ERROR_DEG = 3.0
"""Largest accepted median pose error of an interval, deg. The error includes the movement of the
sensors while a sample waits for the other samples of its batch."""
MOST_MISSING = 0.01
"""Largest accepted share of samples that are lost or dropped. A larger share shows that the daemon
is too slow for the factor, so the run has not tested normal operation."""
LEAST_SAMPLES = 10_000_000
"""Number of samples below which buffers are still filling, so that slopes prove nothing."""
BLOCKS = 12
"""Number of blocks. The line is fitted to the lower quartile of each block."""
WARM_UP = 0.25
"""Share of the run that is left out."""
FALSE_ALARMS = 0.05
"""Probability that a run without growth has a slope in any quantity."""


@dataclass(frozen=True, slots=True)
class Slope:
    """A line through the values of a run."""

    per_million: float
    """Slope, units per million samples."""
    half_width: float
    """Half width of the confidence interval of the slope, same unit."""
    mean: float

    @property
    def is_zero(self) -> bool:
        """Whether the interval contains zero."""
        return abs(self.per_million) <= self.half_width


def slope_of(samples: ArrayLike, values: ArrayLike, quantities: int) -> Slope:
    """Return the slope of values over the number of samples received.

    Parameters
    ----------
    samples, values : array_like, shape (n,)
        Samples received at each measurement, and the measured values.
    quantities : int
        Number of quantities that are examined together (Bonferroni).

    Raises
    ------
    ValueError
        There are fewer than two values for each block.
    """
    x, y = np.asarray(samples, dtype=float) / 1e6, np.asarray(values, dtype=float)
    late = x >= x[0] + WARM_UP * (x[-1] - x[0])
    x, y = x[late], y[late]
    if len(x) < 2 * BLOCKS:
        raise ValueError(f"{len(x)} values after the warm-up, expected at least {2 * BLOCKS}")
    x = np.array([part.mean() for part in np.array_split(x, BLOCKS)])
    y = np.array([np.quantile(part, 0.25) for part in np.array_split(y, BLOCKS)])
    if np.ptp(y) == 0.0:
        return Slope(0.0, 0.0, float(y[0]))
    fit = stats.linregress(x, y)
    confidence = 1.0 - FALSE_ALARMS / quantities / 2.0
    width = float(stats.t.ppf(confidence, BLOCKS - 2) * fit.stderr)
    return Slope(float(fit.slope), width, float(y.mean()))


def table_of(results: dict[str, Any]) -> str:
    """Return the slopes of a run as a table."""
    rows = ["| quantity | level | slope per million samples, interval |", "| --- | --: | --: |"]
    for name, slope in results["slopes"].items():
        interval = f"{slope['per_million']:+.3g} ± {slope['half_width']:.2g}"
        rows.append(f"| {name} | {slope['mean']:.4g} | {interval} |")
    return "\n".join(rows)


def outcomes_of(results: dict[str, Any]) -> str:
    """Return the counters of a run and its largest error as sentences."""
    counters = results["counters"]
    received = f"{counters['received']:,}".replace(",", " ")
    return (
        f"Of {received} samples that the daemon received in all, {counters['late']} were late,"
        f" {counters['dropped']} were dropped, and {counters['unaccounted']} had no outcome;"
        f" {counters['lost']} more were lost on the lines."
        f" Sensors were reconnected {counters['reconnects']} times."
        f" The largest median error of the poses in an interval was"
        f" {results['worst_error_deg']:g}°."
        f" Result: {'; '.join(faults_of(results)) or 'nothing grows'}."
    )


def faults_of(results: dict[str, Any]) -> list[str]:
    """Return a sentence for each value that has a slope, is unknown, or exceeds its limit."""
    faults = [
        f"{name} has a slope of {slope['per_million']:+.3g} ± {slope['half_width']:.2g}"
        " per million samples"
        for name, slope in results["slopes"].items()
        if abs(slope["per_million"]) > slope["half_width"]
    ]
    faults += [
        f"{name}: some values are unknown"
        for name, slope in results["slopes"].items()
        if math.isnan(slope["per_million"])
    ]
    if results["worst_error_deg"] > MOST_ERROR_DEG:
        faults.append(f"{ERROR}: {results['worst_error_deg']}, limit {MOST_ERROR_DEG:g}")
    counters = results["counters"]
    if counters["unaccounted"]:
        faults.append(f"{counters['unaccounted']} samples have no outcome, expected 0")
    missing = counters["lost"] + counters["dropped"]
    if missing > MOST_MISSING * counters["received"]:
        faults.append(
            f"{missing} samples were lost or dropped, {counters['received']} received, expected at"
            f" most {MOST_MISSING:.0%}: choose a smaller --factor than {results['factor']}"
        )
    return faults


def warning_of(samples: int) -> str:
    """Return a warning that a run is too short to judge growth; an empty text if it is not."""
    if samples >= LEAST_SAMPLES:
        return ""
    return (
        f"{samples} samples are too few to distinguish growth from buffers that fill: use at least"
        f" {LEAST_SAMPLES}"
    )
