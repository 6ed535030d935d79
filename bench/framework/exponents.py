"""Exponent of a cost that grows with a size, from its marginal cost.

A cost is modelled as ``fixed + unit · size^exponent``. The marginal cost is the difference of the
costs of two neighbouring sizes, divided by the difference of the sizes, so the fixed cost cancels.
If the sizes have equal ratios, the logarithm of the marginal cost is linear in the logarithm of the
size, with the slope ``exponent − 1``. The slope and its confidence interval are from ordinary least
squares.

Invariant: a constant that is added to all costs does not change the exponent.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import stats

if TYPE_CHECKING:
    from collections.abc import Sequence

CONFIDENCE = 0.95


class Exponent(NamedTuple):
    """Estimated exponent with its confidence interval."""

    value: float
    half_width: float
    """Half of the width of the 95 % confidence interval."""


def growth_exponent(sizes: Sequence[float], costs: Sequence[float]) -> Exponent:
    """Return the exponent of the part of a cost that grows with the size.

    Parameters
    ----------
    sizes : sequence of float
        At least four increasing sizes with about equal ratios.
    costs : sequence of float
        Cost of each size, in any unit.

    Raises
    ------
    ValueError
        A larger size does not cost more than the previous size, so no exponent exists.
    """
    n, cost = np.asarray(sizes, dtype=np.float64), np.asarray(costs, dtype=np.float64)
    marginal = np.diff(cost) / np.diff(n)
    if (marginal <= 0.0).any():
        raise ValueError(f"the costs {cost.tolist()} of the sizes {n.tolist()} do not increase")
    found = log_slope(np.sqrt(n[1:] * n[:-1]).tolist(), marginal.tolist())
    return Exponent(1.0 + found.value, found.half_width)


def log_slope(sizes: Sequence[float], values: Sequence[float]) -> Exponent:
    """Return the slope of the logarithm of positive values over the logarithm of the sizes."""
    x, y = np.log(np.asarray(sizes, dtype=np.float64)), np.log(np.asarray(values, dtype=np.float64))
    x -= x.mean()
    slope = float(x @ y / (x @ x))
    residual = y - y.mean() - slope * x
    freedom = len(x) - 2
    error = float(np.sqrt(residual @ residual / freedom / (x @ x)))
    return Exponent(slope, float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, freedom)) * error)
