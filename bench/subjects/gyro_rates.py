"""Measured angular rates as input of the lag estimate, without an orientation filter."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.timing.lag import Rates

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

GAP = 1.5
"""Time between two samples, in nominal periods, above which samples are missing."""


def rates_from_gyro(t_ns: NDArray[np.int64], w: Array, origin_ns: int) -> Rates:
    """Return measured angular rates as input of the lag estimate.

    Parameters
    ----------
    t_ns
        Stamps, ns, shape (n,).
    w
        Angular rates, rad/s, shape (n, 3). Rows with NaN count as missing samples.
    origin_ns
        Stamp that becomes 0 s.
    """
    seen = np.isfinite(w).all(axis=1)
    t = 1e-9 * np.asarray(np.asarray(t_ns)[seen] - origin_ns, dtype=np.float64)
    step = np.diff(t)
    period = float(np.median(step))
    whole = (step > 0) & (step < GAP * period)
    run = np.concatenate(([0], np.cumsum(~whole)))
    share = float(step[whole].sum() / (t[-1] - t[0]))
    return Rates(t, w[seen], run, period, share)
