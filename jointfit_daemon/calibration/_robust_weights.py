"""Statistics of residuals: RMS, robust scale, Huber weights and effective sample count."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

HUBER_K = 1.5
"""Ratio of residual to robust scale above which the weight is reduced."""

MAX_PASSES = 30
"""Largest number of reweighting iterations."""
SETTLED = 1e-7
"""Largest change of a weight at which the iteration has converged."""

_MEDIAN_TO_SD = 1.4826


def rms(values: NDArray[np.float64], empty: float = np.nan) -> float:
    """Return the RMS of the finite values of an array, in their unit; `empty` if it has none."""
    good = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(good**2))) if good.size else empty


def robust_scale(magnitudes: NDArray[np.float64], floor: float = 1e-6) -> float:
    """Return 1.4826 times the median of magnitudes, shape (n,), in their unit; at least `floor`."""
    return max(_MEDIAN_TO_SD * float(np.median(magnitudes)), floor)


def huber_weights(magnitudes: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Return the weights min(1, 1.5 `scale` / `magnitudes`). Source: Huber 1964."""
    return np.minimum(1.0, HUBER_K * scale / np.maximum(magnitudes, 1e-300))


def effective_count(residuals: NDArray[np.float64]) -> float:
    r"""Return the number of independent samples in a series of residuals.

    .. math:: n_{eff} = n \frac{1 - \rho_1}{1 + \rho_1}

    where :math:`\rho_1` is the lag-one autocorrelation of the series about its mean, over all
    columns. The result is at most n.

    Parameters
    ----------
    residuals : ndarray, shape (n, k)
    """
    n = len(residuals)
    centered = residuals - residuals.mean(axis=0)
    total = float(np.sum(centered**2))
    if n < 3 or total == 0.0:
        return float(n)
    rho = float(np.sum(centered[1:] * centered[:-1])) / total
    rho = min(max(rho, 0.0), 1.0 - 1.0 / n)
    return max(1.0, n * (1.0 - rho) / (1.0 + rho))
