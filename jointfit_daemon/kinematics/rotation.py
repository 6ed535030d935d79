"""Unit quaternions as NumPy arrays, with products, rotation vectors, matrices and means.

Quaternions are Hamilton quaternions, scalar first. Arrays have the shape (..., 4) and broadcast
against each other; vectors have the shape (..., 3). ``q_a_b`` maps b-coordinates to a-coordinates,
and the composition is ``q_a_c = multiply(q_a_b, q_b_c)``. A quaternion and its negative are the
same rotation. Differences, averages and interpolation in this module are independent of the sign.
Code that uses individual components must align signs first. ``rotation_scalar`` is faster for one
sample at a time.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array


IDENTITY: Array = np.array([1.0, 0.0, 0.0, 0.0])
IDENTITY.setflags(write=False)

_CONJUGATE: Array = np.array([1.0, -1.0, -1.0, -1.0])
_SMALL_ANGLE = 1e-6  # rad; for smaller x the series of sin(x/2)/x is exact to rounding
_SMALL_SINE = 1e-9


def _floats(value: ArrayLike) -> Array:
    return np.asarray(value, dtype=np.float64)


def multiply(p: ArrayLike, q: ArrayLike) -> Array:
    r"""Return the Hamilton product.

    .. math:: p \otimes q = (p_w q_w - p_v \cdot q_v,\; p_w q_v + q_w p_v + p_v \times q_v)

    Parameters
    ----------
    p, q : array_like, shape (..., 4)
        Factors, which broadcast against each other.

    Returns
    -------
    ndarray, shape (..., 4)
    """
    pw, px, py, pz = np.moveaxis(_floats(p), -1, 0)
    qw, qx, qy, qz = np.moveaxis(_floats(q), -1, 0)
    return np.stack(
        (
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ),
        axis=-1,
    )


def conjugate(q: ArrayLike) -> Array:
    """Return the conjugate, which is the inverse of a unit quaternion; shape (..., 4)."""
    return np.multiply(_floats(q), _CONJUGATE)


def normalize(q: ArrayLike) -> Array:
    """Return q / |q|, shape (..., 4); NaN where q is zero or not finite."""
    q = _floats(q)
    with np.errstate(divide="ignore", invalid="ignore"):
        scaled: Array = q / np.linalg.norm(q, axis=-1, keepdims=True)
    return np.where(np.isfinite(scaled), scaled, np.nan)


def rotate(q: ArrayLike, v: ArrayLike) -> Array:
    r"""Rotate vectors by v + w t + q_v x t, where t = 2 q_v x v and q = (w, q_v).

    Parameters
    ----------
    q : array_like, shape (..., 4)
        Unit quaternion ``q_a_b``.
    v : array_like, shape (..., 3)
        Vectors in b-coordinates.

    Returns
    -------
    ndarray, shape (..., 3)
        The same vectors in a-coordinates.
    """
    q, v = _floats(q), _floats(v)
    t = 2.0 * np.cross(q[..., 1:], v)
    turned: Array = v + q[..., :1] * t + np.cross(q[..., 1:], t)
    return turned


def exp(r: ArrayLike) -> Array:
    """Return the quaternions, shape (..., 4), of rotation vectors, rad, shape (..., 3)."""
    r = _floats(r)
    angle = np.linalg.norm(r, axis=-1, keepdims=True)
    small = angle < _SMALL_ANGLE
    safe = np.where(small, 1.0, angle)
    scale = np.where(small, 0.5 - angle**2 / 48.0, np.sin(0.5 * angle) / safe)
    return np.concatenate((np.cos(0.5 * angle), scale * r), axis=-1)


def log(q: ArrayLike) -> Array:
    """Return the shortest rotation vector of unit quaternions, rad, shape (..., 4) to (..., 3).

    The length of the vector is at most pi, and q and -q have the same vector. The angle is computed
    by atan2, because acos loses all digits near the identity.
    """
    q = _floats(q)
    q = np.where(q[..., :1] < 0.0, -q, q)
    w, v = q[..., :1], q[..., 1:]
    sine = np.linalg.norm(v, axis=-1, keepdims=True)
    small = sine < _SMALL_SINE
    scale = np.where(small, 2.0, 2.0 * np.arctan2(sine, w) / np.where(small, 1.0, sine))
    vector: Array = scale * v
    return vector


def angle_between(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the angle of the rotation from a to b, rad in [0, pi], shape (...)."""
    between = multiply(conjugate(a), b)
    sine = np.linalg.norm(between[..., 1:], axis=-1)
    angle: Array = 2.0 * np.arctan2(sine, np.abs(between[..., 0]))
    return angle


def to_matrix(q: ArrayLike) -> Array:
    """Return rotation matrices, shape (..., 3, 3), of unit quaternions, shape (..., 4)."""
    w, x, y, z = np.moveaxis(_floats(q), -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def from_matrix(R: ArrayLike) -> Array:
    """Return unit quaternions with w >= 0, shape (..., 4), of rotation matrices, shape (..., 3, 3).

    The largest of the four components is computed by a square root. The other components are
    computed by division. The method is accurate at all angles. Source: Shepperd 1978.
    """
    R = _floats(R)
    trace = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2]
    diagonal = np.stack((R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]), axis=-1)
    products = np.empty((*R.shape[:-2], 4, 4))  # 4 q_i q_j
    products[..., 0, 0] = 1.0 + trace
    for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
        products[..., i + 1, i + 1] = 1.0 + 2.0 * diagonal[..., i] - trace
        products[..., 0, i + 1] = products[..., i + 1, 0] = R[..., k, j] - R[..., j, k]
        products[..., j + 1, k + 1] = products[..., k + 1, j + 1] = R[..., j, k] + R[..., k, j]
    squares = np.stack([products[..., i, i] for i in range(4)], axis=-1)
    best = np.argmax(squares, axis=-1)
    column = np.take_along_axis(products, best[..., None, None], axis=-1)[..., 0]
    q = normalize(column)
    return np.where(q[..., :1] < 0.0, -q, q)


def heading(angle: ArrayLike) -> Array:
    """Return the rotation by `angle` (rad, shape (...)) about the vertical z; shape (..., 4)."""
    half = 0.5 * _floats(angle)
    zero = np.zeros_like(half)
    return np.stack((np.cos(half), zero, zero, np.sin(half)), axis=-1)


def heading_of(q: ArrayLike) -> Array:
    """Return the rotation about the vertical, rad in (-pi, pi], shape (...).

    The result, ``2 atan2(z, w)``, is the rotation about the vertical that is closest to q. It is 0
    if z and w are zero.
    """
    q = _floats(q)
    twice = 2.0 * np.arctan2(q[..., 3], q[..., 0])
    wrapped: Array = np.pi - np.mod(np.pi - twice, 2.0 * np.pi)
    return wrapped


def interpolate(q0: ArrayLike, q1: ArrayLike, a: ArrayLike) -> Array:
    """Return q0 exp(a log(q0* q1)), the rotation at fraction `a`, shape (...), from q0 to q1."""
    share = _floats(a)[..., None]
    return multiply(q0, exp(share * log(multiply(conjugate(q0), q1))))


def average(q: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """Return the mean rotation, the dominant eigenvector of the weighted sum of q q^T.

    The mean minimizes the weighted squared chordal distance and does not depend on the signs of q.
    Source: Markley et al. 2007, doi 10.2514/1.28949, eq. 12.

    Parameters
    ----------
    q : array_like, shape (..., n, 4)
        Rotations to average over axis -2, without NaN.
    weights : array_like, shape (..., n), optional
        Weights of the rotations, non-negative; equal weights if None.

    Returns
    -------
    ndarray, shape (..., 4)
        Mean as unit quaternion with w >= 0.

    Raises
    ------
    ValueError
        There are no rotations.
    """
    q = _floats(q)
    if q.shape[-2] == 0:
        raise ValueError("no rotations to average")
    weighted = q if weights is None else q * _floats(weights)[..., None]
    largest: Array = np.linalg.eigh(np.swapaxes(weighted, -1, -2) @ q)[1][..., -1]
    return np.where(largest[..., :1] < 0.0, -largest, largest)


def align_hemisphere(q: ArrayLike, ref: ArrayLike) -> Array:
    """Return q or -q with a non-negative dot product with `ref`; shape (..., 4)."""
    q = _floats(q)
    product = np.sum(q * _floats(ref), axis=-1, keepdims=True)
    return np.where(product < 0.0, -q, q)


def continuous(q: ArrayLike) -> Array:
    """Return a series, shape (n, 4), with non-negative dot products of successive quaternions.

    Rows with NaN are unchanged. The rows before and after them also have a non-negative product.
    """
    q = _floats(q).copy()
    seen = np.flatnonzero(np.isfinite(q).all(axis=-1))
    if seen.size > 1:
        good = q[seen]
        flips = np.where(np.sum(good[1:] * good[:-1], axis=-1) < 0.0, -1.0, 1.0)
        q[seen[1:]] = good[1:] * np.cumprod(flips)[:, None]
    return q


def left_matrix(q: ArrayLike) -> Array:
    """Return L with ``multiply(q, p) == L @ p``; shape (..., 4, 4)."""
    w, x, y, z = np.moveaxis(_floats(q), -1, 0)
    rows = ((w, -x, -y, -z), (x, w, -z, y), (y, z, w, -x), (z, -y, x, w))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def right_matrix(q: ArrayLike) -> Array:
    """Return R with ``multiply(p, q) == R @ p``; shape (..., 4, 4)."""
    w, x, y, z = np.moveaxis(_floats(q), -1, 0)
    rows = ((w, -x, -y, -z), (x, w, z, -y), (y, -z, w, x), (z, y, -x, w))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def skew(v: ArrayLike) -> Array:
    """Return the matrix of the cross product, ``skew(v) @ u == cross(v, u)``; shape (..., 3, 3)."""
    x, y, z = np.moveaxis(_floats(v), -1, 0)
    zero = np.zeros_like(x)
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
