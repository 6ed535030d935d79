"""Band-limited random signals, which can be evaluated at any times in any order.

Invariant: a signal depends on the time and its seed only. Streams of different rates therefore
sample the same signal, and a run is reproducible.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

LINES = 48
"""Number of sinusoids. With fewer sinusoids, the signal repeats visibly and its RMS fluctuates."""


class RandomSignal:
    r"""Stationary, nearly Gaussian signal of several channels within a frequency band.

    .. math:: x_c(t) = \sum_k (a_{ck}\cos 2\pi f_k t + b_{ck}\sin 2\pi f_k t)

    This is Rice's sum of sinusoids for each channel *c* (Bell Syst. Tech. J. 23, 1944). The band is
    divided into equal parts, and each frequency :math:`f_k` is random within its part. The
    amplitudes :math:`a_{ck}` and :math:`b_{ck}` are random, and scaled so that every channel has
    exactly its RMS over a time much longer than ``1/low_hz``.

    Parameters
    ----------
    random
        Random generator of frequencies and amplitudes. Only the constructor uses it.
    channels
        Number of signals.
    low_hz, high_hz
        Limits of the band, Hz.
    rms
        RMS of each channel, any unit.
    """

    def __init__(
        self,
        random: np.random.Generator,
        channels: int,
        *,
        low_hz: float,
        high_hz: float,
        rms: float,
    ) -> None:
        edges = np.linspace(low_hz, high_hz, LINES + 1)
        self._omega = 2 * np.pi * random.uniform(edges[:-1], edges[1:])
        amplitudes = random.standard_normal((2 * LINES, channels))
        power = np.sum(amplitudes**2, axis=0) / 2
        self._amplitudes = amplitudes * (rms / np.sqrt(power))

    def at(self, t_s: Array) -> Array:
        """Return the signals, shape (n, channels), at the times `t_s` of shape (n,)."""
        phase = t_s[:, None] * self._omega
        waves = np.concatenate((np.cos(phase), np.sin(phase)), axis=1)
        signals: Array = waves @ self._amplitudes
        return signals


def random_vector_signal(
    random: np.random.Generator, vectors: int, *, low_hz: float, high_hz: float, rms: float
) -> RandomSignal:
    """Return a signal of isotropic 3-vectors whose *length* has the given RMS."""
    return RandomSignal(random, 3 * vectors, low_hz=low_hz, high_hz=high_hz, rms=rms / np.sqrt(3))
