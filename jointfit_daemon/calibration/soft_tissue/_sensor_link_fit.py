r"""Fit of the links between the sensors of a limb.

A link predicts the relation of two sensors from posture, by a weighted sum of polynomials
:math:`\phi`. The weights are fitted to a movement by ridge regression. Their covariance is

.. math::

    C = \Bigl(\frac{m}{\sigma_0^2} \overline{\phi\phi^\mathsf{T}} + \tau^{-2} S^2 \Bigr)^{-1}

where :math:`\sigma_0` is the RMS residual on held-out blocks and :math:`S` the diagonal matrix of
the RMS values of the polynomials. :math:`\tau` is the RMS of the predicted quantity. It is the
prior standard deviation of the weight of each polynomial after scaling to RMS 1 (C. M. Bishop,
Pattern Recognition and Machine Learning, 2006, section 3.3). The residuals of neighboring frames
are similar, so the n frames count as m independent frames:

.. math:: m = n \Big/ \Bigl(1 + 2 \sum_{k=1}^{K} \rho_k \rho'_k\Bigr)

where :math:`\rho` is the autocorrelation of the residuals, :math:`\rho'` the autocorrelation of the
polynomials, and K the last lag before :math:`\rho` becomes negative.
"""

from __future__ import annotations

from itertools import combinations, product
from math import radians
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    LEAST_LEVEL,
    LinkKind,
    SensorLink,
    inner_joints,
    level_axis,
    neighbor,
    posture_one,
    up_one,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.model import Chain


RIDGE = 1e-3
"""Penalty of the ridge regression."""

BLOCKS = 5
"""Number of held-out blocks, which are contiguous in time."""

FEWEST_FRAMES = 100
"""Smallest number of complete frames."""

LEAST_SPREAD = radians(0.3)
"""Lower bound of the RMS residual and of the prior standard deviation, rad."""


def fit_links(
    chain: Chain, sensors: Mapping[str, Array], q_static: Mapping[str, ArrayLike]
) -> tuple[SensorLink, ...]:
    """Fit all links of a limb to a movement, by ridge regression on posture.

    The standard deviation of a link is its RMS residual on held-out blocks.

    Parameters
    ----------
    chain : Chain
        Segments and their sensors.
    sensors : mapping of str to ndarray, shape (n, 4)
        q_optical_segment of each sensor, computed with its mount, at common instants in order of
        time; frames with NaN are ignored.
    q_static : mapping
        q_optical_segment of each segment in the static pose.

    Returns
    -------
    tuple of SensorLink
        Links; empty with fewer than 100 complete frames.
    """
    links = []
    for i, group in enumerate(chain.sensors):
        near = neighbor(chain, i) or group
        links += [_fit("pair", (a, b), near, sensors) for a, b in combinations(group, 2)]
        for distal in (joint.distal for joint in inner_joints(chain) if joint.proximal == i):
            q_a, q_b = (q_static[chain.segments[k]] for k in (i, distal))
            standing = float(_axis_headings(np.array([q_a]), np.array([q_b]))[0])
            links += [
                _fit("joint", (a, b), (b,), sensors, standing)
                for a, b in product(group, chain.sensors[distal])
            ]
    return tuple(link for link in links if link is not None)


def _fit(
    kind: LinkKind,
    ends: tuple[str, str],
    near: tuple[str, ...],
    sensors: Mapping[str, Array],
    standing: float = 0.0,
) -> SensorLink | None:
    a, b = ends
    q_a, q_b, q_near = sensors[a], sensors[b], sensors[near[0]]
    if kind == "pair":
        wanted = rotation.log(rotation.multiply(rotation.conjugate(q_a), q_b))
    else:
        angle = _axis_headings(q_a, q_b) - standing
        wanted = np.arctan2(np.sin(angle), np.cos(angle))[:, None]

    u, v = (np.stack(up_one(tuple(q.T)), axis=0) for q in (q_a, q_near))
    shown = np.stack(posture_one(tuple(u), tuple(v)), axis=1)
    known = np.isfinite(wanted).all(axis=1) & np.isfinite(shown).all(axis=1)
    shown, wanted = shown[known], wanted[known]
    if len(shown) < FEWEST_FRAMES:
        return None

    # Residuals on held-out blocks.
    residuals = []
    for held in np.array_split(np.arange(len(shown)), BLOCKS):
        rest = np.ones(len(shown), dtype=bool)
        rest[held] = False
        residuals.append(wanted[held] - shown[held] @ _ridge(shown[rest], wanted[rest]))

    residual = np.concatenate(residuals)
    spread = float(max(np.sqrt(np.mean(residual**2)), LEAST_SPREAD))
    total = float(np.sqrt(np.mean(wanted**2)))
    return SensorLink(
        a=a,
        b=b,
        kind=kind,
        near=near,
        weights=tuple(tuple(row) for row in _ridge(shown, wanted).T.tolist()),
        low=tuple(shown.min(axis=0).tolist()),
        high=tuple(shown.max(axis=0).tolist()),
        spread=spread,
        total=total,
        uncertainty=_uncertainty(shown, residual, spread, total),
    )


def _uncertainty(
    shown: Array, residual: Array, spread: float, total: float
) -> tuple[tuple[float, ...], ...]:
    """Return U with C = U^T U, shape (10, 10), rad."""
    scale = np.sqrt(np.mean(shown**2, axis=0)) + 1e-6
    g = shown / scale
    frames = independent_frames(residual, g)
    information = frames / spread**2 * (g.T @ g) / len(g)
    information += np.eye(g.shape[1]) / max(total, LEAST_SPREAD) ** 2

    # The information is L L^T, so U = L^-1 for the scaled polynomials.
    factor = np.linalg.inv(np.linalg.cholesky(information)) / scale
    return tuple(tuple(row) for row in factor.tolist())


def independent_frames(residual: Array, regressors: Array) -> float:
    """Return the number of independent frames in a regression with correlated residuals.

    Parameters
    ----------
    residual : ndarray, shape (n, components)
        Residuals at constant intervals, in order of time.
    regressors : ndarray, shape (n, weights)
        Values of the regressors, scaled to similar magnitude.

    Returns
    -------
    float
        Number from 1 to n.
    """
    n = len(residual)
    correlation = _autocorrelation(residual)
    crossing = int(np.argmax(correlation < 0.0)) or n
    alike = float(correlation[:crossing] @ _autocorrelation(regressors)[:crossing])
    return n / max(2.0 * alike - 1.0, 1.0)


def _autocorrelation(values: Array) -> Array:
    """Return the autocorrelation about zero, summed over the columns, shape (n,)."""
    n = len(values)
    spectrum = np.fft.rfft(values, 2 * n, axis=0)  # padded against wrap-around
    products: Array = np.fft.irfft((spectrum * spectrum.conj()).real.sum(axis=1))[:n]
    if products[0] <= 0.0:
        return np.ones(n)  # a perfect fit is no evidence of independence
    return np.asarray(products / products[0])


def _ridge(shown: Array, wanted: Array) -> Array:
    """Return the weights of the polynomials, shape (10, components).

    There is no intercept, because polynomials and target are zero in the upright posture.
    """
    scale = np.sqrt(np.mean(shown**2, axis=0)) + 1e-6
    g = shown / scale
    H = g.T @ g + RIDGE * len(g) * np.eye(g.shape[1])
    found: Array = np.linalg.solve(H, g.T @ wanted) / scale[:, None]
    return found


def _axis_headings(q_a: Array, q_b: Array) -> Array:
    ax, ay = level_axis(tuple(q_a.T))
    bx, by = level_axis(tuple(q_b.T))
    steep = (ax**2 + ay**2 < LEAST_LEVEL) | (bx**2 + by**2 < LEAST_LEVEL)
    found: Array = np.where(steep, np.nan, np.arctan2(ax * by - ay * bx, ax * bx + ay * by))
    return found
