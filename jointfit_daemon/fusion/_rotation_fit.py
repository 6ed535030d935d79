r"""Rotation between two sets of matched points a_k and y_k, computed without matrix operations.

The rotation is the unit quaternion q that maximizes :math:`q^T N q` (Horn 1987, J. Opt. Soc. Am. A
4:629), an eigenvector of the largest eigenvalue of the symmetric matrix N. With the cross moment
:math:`S = \sum_k a_k y_k^T`, the characteristic polynomial of N is

.. math:: p(\lambda) = (\lambda^2 - F)^2 - 8 D \lambda - 4 C, \quad
          F = |S|^2, \quad D = \det S, \quad C = |\mathrm{cof}\, S|^2

All roots are real, so Newton's method from above converges to the largest root (Theobald 2005, Acta
Cryst. A 61:478). The eigenvector is a column of the adjugate of :math:`N - \lambda I`.

Invariant: every operation is scalar, so that compiled and interpreted code agree bit for bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.kinematics.rotation_scalar import normalize_one

if TYPE_CHECKING:
    from jointfit_daemon.model import Quaternion, Vector

_MOST_STEPS = 60
"""Largest number of Newton steps. A simple root takes about six. At a double root each step halves
the error.
"""
_CONVERGED = 1e-16
"""Relative step below which only rounding errors of the root remain."""
_LARGE = 0.2
"""Square of a component of q above which the corresponding column of the adjugate is used. The
largest of the four squares is at least 0.25.
"""

_Rest = tuple[float, float, float, float, float, float]


def fit_rotation(s: tuple[Vector, Vector, Vector], bound: float) -> tuple[Quaternion, float]:
    """Return the rotation R that maximizes the sum of ``y · R a``, and the maximum.

    Parameters
    ----------
    s : tuple of three Vector
        Rows of the cross moment, sum of ``a_i y_j``, m².
    bound : float
        Upper bound of the sum, such as the square root of the product of the moments of a and y,
        m².

    Returns
    -------
    q : Quaternion
        q_y_a with w >= 0.
    largest : float
        Maximum of the sum, m².

    Raises
    ------
    ZeroDivisionError
        The moment does not determine a rotation.
    """
    (a, b, c), (d, e, f), (g, h, i) = s
    largest, slope = _largest_root(s, bound)

    # The adjugate of N - λ I is -p'(λ) q q^T, so each column is q times one component of q.
    ww, xx, yy, zz = (
        a + e + i - largest,
        a - e - i - largest,
        e - a - i - largest,
        i - a - e - largest,
    )
    wx, wy, wz, xy, xz, yz = f - h, g - c, b - d, b + d, c + g, f + h
    least = -_LARGE * slope
    w, x, y, z = _adjugate_column((wx, wy, wz), (xx, xy, xz, yy, yz, zz))
    if w > least:
        x, w, y, z = _adjugate_column((wx, xy, xz), (ww, wy, wz, yy, yz, zz))
        if x > least:
            y, w, x, z = _adjugate_column((wy, xy, yz), (ww, wx, wz, xx, xz, zz))
            if y > least:
                z, w, x, y = _adjugate_column((wz, xz, yz), (ww, wx, wy, xx, xy, yy))
    w, x, y, z = normalize_one((w, x, y, z))
    return ((-w, -x, -y, -z) if w < 0.0 else (w, x, y, z)), largest


def _largest_root(s: tuple[Vector, Vector, Vector], bound: float) -> tuple[float, float]:
    """Return the largest root of p, and the derivative of p there."""
    (a, b, c), (d, e, f), (g, h, i) = s
    square = a * a + b * b + c * c + d * d + e * e + f * f + g * g + h * h + i * i
    p, q, r = e * i - f * h, f * g - d * i, d * h - e * g
    t, u, v = c * h - b * i, a * i - c * g, b * g - a * h
    j, k, m = b * f - c * e, c * d - a * f, a * e - b * d
    linear = 8.0 * (a * p + b * q + c * r)
    constant = 4.0 * (p * p + q * q + r * r + t * t + u * u + v * v + j * j + k * k + m * m)

    root = bound
    for _ in range(_MOST_STEPS):
        inner = root * root - square
        step = (inner * inner - linear * root - constant) / (4.0 * root * inner - linear)
        if not step > _CONVERGED * root:
            break
        root -= step
    return root, 4.0 * root * (root * root - square) - linear


def _adjugate_column(side: Vector, rest: _Rest) -> Quaternion:
    """Return the first column of the adjugate of a symmetric matrix of order 4.

    Parameters
    ----------
    side : Vector
        First column without its first element, which has no effect on the result.
    rest : tuple of 6 floats
        Upper triangle of the other rows.
    """
    (ab, ac, ad), (bb, bc, bd, cc, cd, dd) = side, rest
    m_ab, m_ac, m_ad = ac * bd - bc * ad, ac * cd - cc * ad, ac * dd - cd * ad
    m_bc, m_bd, m_cd = bc * cd - cc * bd, bc * dd - cd * bd, cc * dd - cd * cd
    return (
        bb * m_cd - bc * m_bd + bd * m_bc,
        bc * m_ad - ab * m_cd - bd * m_ac,
        ab * m_bd - bb * m_ad + bd * m_ab,
        bb * m_ac - ab * m_bc - bc * m_ab,
    )
