"""Cramér-Rao bounds of a circle's center.

A bound depends on the movement and the noise only. It is infinite where the movement carries no
information about the center.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array


def circle_bound(angles: ArrayLike, noise: float, *, known_radius: bool = False) -> Array:
    r"""Return the least covariance of a circle's center from points at these angles.

    .. math:: C = \sigma^2 \Big[ \sum_i u_i u_i^T \Big]^{-1}_{xy},
              \qquad u_i = (\cos\theta_i, \sin\theta_i, 1)

    without the 1 where the radius is known.

    Parameters
    ----------
    angles : array_like, shape (n,)
        Of the points about the center, rad.
    noise : float
        Standard deviation of each coordinate, m.
    known_radius : bool
        The radius need not be found.

    Returns
    -------
    ndarray, shape (2, 2)
        m²; inf on the diagonal where the points do not show a center.
    """
    t = np.asarray(angles, dtype=np.float64)
    columns = [np.cos(t), np.sin(t)]
    if not known_radius:
        columns.append(np.ones_like(t))
    u = np.column_stack(columns)
    F = u.T @ u
    scale = float(np.trace(F))
    if t.size == 0 or float(np.linalg.eigvalsh(F)[0]) <= 1e-15 * scale:
        return np.diag([np.inf, np.inf])
    return np.asarray(noise**2 * np.linalg.inv(F)[:2, :2])


def circle_rms_bound(angles: ArrayLike, noise: float, *, known_radius: bool = False) -> float:
    """Return the least RMS error of a circle's center, m; parameters as in `circle_bound`."""
    return float(np.sqrt(np.trace(circle_bound(angles, noise, known_radius=known_radius))))


def uniform_arc_rms(arc: float, frames: int, noise: float, *, known_radius: bool = False) -> float:
    r"""Return `circle_rms_bound` for many points spread evenly over an arc, in closed form, m.

    .. math:: E^2 = \frac{\sigma^2}{n} \left[ \frac{2}{1-c} + \frac{2}{1+c-2s^2} \right],
              \quad s = \frac{\sin(\varphi/2)}{\varphi/2}, \quad c = \frac{\sin\varphi}{\varphi}

    and without 2s² where the radius is known; about 26.8 σ/(√n φ²) on short arcs.

    Parameters
    ----------
    arc : float
        φ, rad, above zero.
    frames : int
        n.
    noise : float
        Standard deviation of each coordinate, m.
    known_radius : bool
        The radius need not be found.
    """
    s = float(np.sinc(arc / (2.0 * np.pi)))
    c = float(np.sinc(arc / np.pi))
    along = 1.0 + c - (0.0 if known_radius else 2.0 * s**2)
    if not known_radius and arc < 0.05:
        along = arc**4 / 360.0  # its series: the difference has no digits there
    if c >= 1.0 or along <= 0.0 or frames <= 0:  # no arc, or one that is lost in rounding
        return float("inf")
    return float(noise * np.sqrt((2.0 / (1.0 - c) + 2.0 / along) / frames))
