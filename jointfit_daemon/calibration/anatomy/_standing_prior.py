"""Prior that a subject stands upright in the static pose, combined with joint centers.

If the arc of the movement is short, a center from skin markers has an uncertainty of centimeters
perpendicular to the limb. The uncertainty is largest at the ankle. Subjects that are asked to stand
upright do so within a few degrees. The movement and the pose are weighted by their covariances, in
a linear Gaussian model.

The *static world* is the optical world as it was during the static pose.
"""

from __future__ import annotations

from itertools import pairwise
from math import radians
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array


STANDING_SD_RAD = radians(2.0)
"""Standard deviation of the tilt of a segment in the static pose, rad per axis.

The value assumes that an operator asks the subject to stand upright."""


def apply_standing_prior(
    centers: Sequence[Array | None],
    covariances: Sequence[Array | None],
    sd: float = STANDING_SD_RAD,
) -> list[tuple[Array, Array] | None]:
    r"""Combine joint centers with the prior that neighboring centers are above each other.

    The matrix S selects horizontal components. The horizontal difference of two neighbors at
    distance L is treated as a measurement of zero with standard deviation L sd,

    .. math:: 0 = S (c_i - c_{i+1}) + e, \qquad e \sim N(0, (L\,sd)^2 I_2)

    Mean and covariance of all centers are computed by one Kalman update per pair of neighbors.

    Parameters
    ----------
    centers : sequence of (ndarray, shape (3,)) or None
        Joint centers in the static world (z up), m, from proximal to distal; None if unknown.
    covariances : sequence of (ndarray, shape (3, 3)) or None
        Covariances of the centers, m², including the error caused by soft-tissue artefact.
    sd : float
        Standard deviation of the tilt of a segment in the static pose, rad.

    Returns
    -------
    list of (center, covariance) or None
        Combined centers in the given order; a center without known neighbors is unchanged.
    """
    known = [i for i, center in enumerate(centers) if center is not None]
    at = {joint: 3 * k for k, joint in enumerate(known)}
    x = np.concatenate([np.asarray(centers[i]) for i in known]) if known else np.zeros(0)
    P = np.zeros((len(x), len(x)))
    for i in known:
        P[at[i] : at[i] + 3, at[i] : at[i] + 3] = covariances[i]

    for upper, lower in pairwise(range(len(centers))):
        if upper not in at or lower not in at:
            continue
        i, j = at[upper], at[lower]
        length = float(np.linalg.norm(x[i : i + 3] - x[j : j + 3]))
        H = np.zeros((2, len(x)))
        H[:, i : i + 2] = np.eye(2)
        H[:, j : j + 2] = -np.eye(2)

        # Kalman update with the measurement 0 = H x.
        S = H @ P @ H.T + (length * sd) ** 2 * np.eye(2)
        K = np.linalg.solve(S, H @ P).T
        Q = P - K @ H @ P
        x, P = x - K @ (H @ x), (Q + Q.T) / 2

    out: list[tuple[Array, Array] | None] = [None] * len(centers)
    for i in known:
        part = slice(at[i], at[i] + 3)
        out[i] = (x[part], P[part, part])
    return out
