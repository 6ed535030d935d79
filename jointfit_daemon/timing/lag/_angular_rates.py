"""Angular rates from orientations or gyros, and their zero-phase low-pass filter.

Invariant: no function shifts a signal in time. A rate is timestamped in the middle of its interval
and every filter is symmetric. A timestamp at the start of the interval would shift the lag by half
a sample.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

KERNEL_HALF_S = 0.08
"""Half length of the low-pass kernel, s. Each gapless run loses this time at both ends."""
GAP = 1.5
"""Interval, in median sample periods, above which samples are missing."""
BRIDGE_S = 0.035
"""Longest gap that is filled with the mean rate over the gap, s. The integral is then exact, the
filling is symmetric, and the gap is shorter than the cut-off period. Longer gaps split the track.
"""

_KAISER = 5.0
"""Shape parameter of the Kaiser window."""
_MOST_ANGLE = np.pi / 2
"""Largest rotation between two poses, rad. A larger rotation is ambiguous."""
_STENCIL = 5
"""Number of samples that the fourth-order difference uses."""


@dataclass(frozen=True, slots=True)
class Rates:
    """Angular rate of a body in its own frame."""

    t_s: Floats
    """Instants since the origin, s, shape (n,)."""
    w: Floats
    """Rates, rad/s, shape (n, 3)."""
    run: NDArray[np.intp]
    """Index of the gapless run of each sample, non-decreasing, shape (n,)."""
    period_s: float
    """Median sample period, s."""
    valid_share: float
    """Fraction of the track's duration that the rates cover."""

    def runs(self) -> list[slice]:
        """Return the gapless runs as slices of the samples."""
        edges = np.flatnonzero(np.diff(self.run)) + 1
        bounds = [0, *edges.tolist(), self.run.size]
        return [slice(a, b) for a, b in pairwise(bounds) if b > a]


def rates_from_orientations(
    t_ns: NDArray[np.int64], q: Floats, origin_ns: int, *, bridge_s: float = BRIDGE_S
) -> Rates:
    r"""Return the body rate between neighboring poses.

    .. math:: \omega_{k+1/2} = \frac{\log(q_k^* q_{k+1})}{t_{k+1} - t_k},
              \quad t_{k+1/2} = \frac{t_k + t_{k+1}}{2}

    Parameters
    ----------
    t_ns : ndarray, shape (n,)
        Instants of the poses, strictly increasing, ns.
    q : ndarray, shape (n, 4)
        q_world_body; rows with NaN are missing poses.
    origin_ns : int
        Instant that becomes 0 s.
    bridge_s : float
        Longest gap that is bridged, s.

    Returns
    -------
    Rates
        Rates, which are empty if fewer than three poses are available.
    """
    seen = np.isfinite(q).all(axis=1)
    t = 1e-9 * np.asarray(np.asarray(t_ns)[seen] - origin_ns, dtype=np.float64)
    if t.size < 3:  # noqa: PLR2004 - one rate is not a track
        return _empty()
    q = q[seen]

    step = np.diff(t)
    period = float(np.median(step))
    turn = rotation.log(rotation.multiply(rotation.conjugate(q[:-1]), q[1:]))
    usable = (step > 0) & (step < max(GAP * period, bridge_s))
    usable &= np.linalg.norm(turn, axis=1) < _MOST_ANGLE

    # A bridged gap is split into equal pieces of about one period.
    pieces = np.where(usable, np.maximum(1, np.rint(step / period)), 0).astype(np.intp)
    first = np.repeat(np.cumsum(pieces) - pieces, pieces)
    share = (np.arange(first.size) - first + 0.5) / np.repeat(pieces, pieces)
    long_step = np.repeat(step, pieces)
    middle: Floats = np.repeat(t[:-1], pieces) + share * long_step
    return Rates(
        t_s=middle,
        w=np.repeat(turn, pieces, axis=0) / long_step[:, None],
        run=np.repeat(np.cumsum(~usable), pieces),
        period_s=period,
        valid_share=float(step[usable].sum() / (t[-1] - t[0])),
    )


def _empty() -> Rates:
    return Rates(np.empty(0), np.empty((0, 3)), np.empty(0, dtype=np.intp), np.inf, 0.0)


def low_pass(rates: Rates, cutoff_hz: float) -> Rates:
    """Return the low-pass filtered rates (sinc times Kaiser, symmetric FIR of 0.16 s).

    The kernel is the same function of time at all sample rates, so two tracks are filtered
    identically. The result contains only samples with full kernel support, so it has no transients.
    """
    half = int(KERNEL_HALF_S / rates.period_s) if np.isfinite(rates.period_s) else 0
    at = np.arange(-half, half + 1) * rates.period_s if half else np.zeros(1)
    window = np.i0(_KAISER * np.sqrt(np.clip(1.0 - (at / KERNEL_HALF_S) ** 2, 0.0, 1.0)))
    kernel = np.sinc(2.0 * cutoff_hz * at) * window
    kernel /= kernel.sum()

    runs = [run for run in rates.runs() if run.stop - run.start >= kernel.size]
    if not runs:
        return _empty()
    inner = [slice(run.start + half, run.stop - half) for run in runs]
    smooth = [
        np.stack([np.convolve(rates.w[run, axis], kernel, "valid") for axis in range(3)], axis=1)
        for run in runs
    ]
    return Rates(
        np.concatenate([rates.t_s[part] for part in inner]),
        np.concatenate(smooth),
        np.concatenate([rates.run[part] for part in inner]),
        rates.period_s,
        rates.valid_share,
    )


class Interpolant:
    """Cubic Hermite interpolant of each run.

    Slopes are central differences of fourth order, and of second order near the ends of a run.
    """

    def __init__(self, rates: Rates) -> None:
        self._t, self._w, self._run = rates.t_s, rates.w, rates.run
        self._gapless = bool(self._run.size) and bool(self._run[0] == self._run[-1])
        self.slopes = np.zeros_like(rates.w)
        """Time derivative at the samples, rad/s², shape (n, 3)."""
        for run in rates.runs():
            t, w, slopes = rates.t_s[run], rates.w[run], self.slopes[run]
            if t.size > 1:
                slopes[:] = np.gradient(w, t, axis=0)
            if t.size >= _STENCIL:
                h = (t[4:] - t[:-4])[:, None] / 4.0
                slopes[2:-2] = (w[:-4] - w[4:] + 8.0 * (w[3:-1] - w[1:-3])) / (12.0 * h)

    def locate(self, t: Floats) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
        """Return the index of each instant's sample interval, and whether a run covers `t`."""
        at, inside, _, _ = self._intervals(t)
        return at, inside

    def _intervals(self, t: Floats) -> tuple[NDArray[np.intp], NDArray[np.bool_], Floats, Floats]:
        """Return the results of ``locate``, and both ends of each interval, s."""
        if self._t.size < 2:  # noqa: PLR2004 - an interval has two ends
            nowhere = np.zeros(t.size)
            return (
                np.zeros(t.size, dtype=np.intp),
                np.zeros(t.size, dtype=np.bool_),
                nowhere,
                nowhere,
            )
        at = np.searchsorted(self._t, t, side="right") - 1
        at = np.minimum(np.maximum(at, 0), self._t.size - 2)
        low, high = self._t[at], self._t[at + 1]
        inside = (t >= low) & (t <= high)
        if not self._gapless:
            inside &= self._run[at] == self._run[at + 1]
        return at, inside, low, high

    def __call__(self, t: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Return value and time derivative, shape (n, 3) each, and validity at instants `t`, s."""
        at, inside, low, high = self._intervals(t)
        if not inside.any():
            return np.zeros((t.size, 3)), np.zeros((t.size, 3)), inside

        h = (high - low)[:, None]
        x = (t - low)[:, None] / h
        after = at + 1
        f0, f1 = self._w.take(at, axis=0), self._w.take(after, axis=0)
        d0, d1 = self.slopes.take(at, axis=0) * h, self.slopes.take(after, axis=0) * h
        rise = f1 - f0
        c2, c3 = 3.0 * rise - 2.0 * d0 - d1, d0 + d1 - 2.0 * rise
        value = f0 + x * (d0 + x * (c2 + x * c3))
        slope = (d0 + x * (2.0 * c2 + 3.0 * x * c3)) / h
        return value, slope, inside
