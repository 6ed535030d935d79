r"""Weights of training frames, with which rare postures influence a fit more than frequent ones.

A functional movement contains many similar frames of slow parts and of rest, and few frames of each
posture of fast parts. Without weights, the frequent postures determine the fit. The weight of frame
i decreases with the density p of the training frames about its posture:

.. math:: w_i \propto p_i^{-1/4}, \qquad
          p_i = \frac1m \sum_{k=1}^{m} e^{-|f_i - f_k|^2 / (2 b^2)} + \frac{1}{2m}

The posture f consists of the joint rotation and the tilt of the segment. The sum contains m frames
at equal intervals. With the exponent 0, all frames would have the same influence. With the exponent
-1, all postures would have the same influence.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.limb_model import TILTS

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

BANDWIDTH = 0.15
"""Standard deviation b of the Gaussian kernel of the density, rad."""
EXPONENT = -0.25
"""Exponent of the density. An exponent nearer to -1 reduces the effect of pauses further, but
increases the errors of simulated subjects, whose training contains all movements in equal parts."""
MOST_KERNELS = 500
"""Largest number m of frames that estimate the density."""


def weigh_postures(u: Array) -> Array:
    """Return the weight of each frame, shape (n,), with mean 1.

    Parameters
    ----------
    u : ndarray, shape (n, 3 m + 3)
        Regressors as returned by `model_inputs`, rad: joint rotation (3 columns), disagreements of
        the sensors, and tilt (3 columns).
    """
    postures = np.concatenate([u[:, :3], u[:, -TILTS:]], axis=1) / BANDWIDTH
    step = -(-len(postures) // MOST_KERNELS)
    kernels = postures[step // 2 :: step]

    squares = np.sum(postures**2, axis=1)[:, None] + np.sum(kernels**2, axis=1)
    distances = np.maximum(squares - 2.0 * postures @ kernels.T, 0.0)
    density = np.mean(np.exp(-0.5 * distances), axis=1) + 0.5 / len(kernels)

    weights: Array = density**EXPONENT
    return weights / np.mean(weights)
