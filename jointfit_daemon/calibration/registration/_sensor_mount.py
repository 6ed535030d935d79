r"""Sensor-to-segment and world-to-world alignment of one sensor.

.. math:: q_{ref,i} = q_W \otimes q_{s,i} \otimes q_B

q_ref is the orientation of the body, q_s the orientation of the sensor, q_W the rotation of the
sensor's world, and q_B the sensor-to-segment alignment. The problem is solved with linear algebra
of 4x4 matrices. Parameters that the movement does not excite are detected and not estimated.

There are three kinds of fit. ``full`` estimates q_W and q_B, ``heading`` restricts q_W to a
rotation about the vertical, and ``mount`` sets q_W = 1. ``full`` and ``heading`` are reliable only
for sensors on a rigid plate. Skin-mounted sensors move with soft tissue. The fit would attribute
this motion to a rotation of the world, with errors of tens of degrees at other headings of the
subject.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from jointfit_daemon.calibration._robust_weights import (
    MAX_PASSES,
    SETTLED,
    effective_count,
    huber_weights,
    robust_scale,
)
from jointfit_daemon.calibration.registration._static_mean import robust_mean
from jointfit_daemon.kinematics import rotation

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

    from jointfit_daemon.arrays import Array

AlignmentKind = Literal["full", "heading", "mount"]

MAX_KAPPA_FULL = 0.95
"""Largest `SensorAlignment.kappa` of an accepted full alignment."""
MAX_KAPPA_HEADING = 0.98
"""Largest `SensorAlignment.kappa` of an accepted heading alignment."""
MAX_WEAK_ERROR = np.deg2rad(1.0)
"""Largest standard error in the least observable direction of the full problem, rad."""
_SAME = 1e-9
"""Relative difference of singular values below which they count as equal."""


@dataclass(frozen=True, slots=True)
class SensorAlignment:
    """Alignment of one sensor with its quality."""

    kind: AlignmentKind
    q_world: Array
    """Rotation q_optical_sensorworld, shape (4,); the identity for kind ``mount``."""
    q_mount: Array
    """Sensor-to-segment alignment q_sensor_body, shape (4,)."""
    kappa: float
    """Ratio of the second to the first singular value of the matrix M in `fit_sensor_alignment`; 0
    for kind ``mount``. At 1 the rotation of the world and the sensor-to-segment alignment cannot be
    distinguished.
    """
    weak_error: float
    """Standard error in the least observable direction, rad; inf if the direction is unobservable.
    """
    residual_rms: float
    """RMS angle between model and reference over all frames, rad."""
    residual_scale: float
    """Robust scale of the residual angles, rad, which is insensitive to outliers."""
    refused: tuple[str, ...] = ()
    """Reasons why the kinds with more parameters were rejected."""


def fit_observable_alignment(
    q_world_sensor: ArrayLike, q_optical_body: ArrayLike
) -> SensorAlignment:
    """Return the alignment with the most parameters that the movement determines.

    Parameters
    ----------
    q_world_sensor : array_like, shape (n, 4)
        Sensor orientations in the world of the sensor.
    q_optical_body : array_like, shape (n, 4)
        Orientations of the body to which the sensor is attached, at the same instants. Rows with
        NaN in either array are ignored.

    Raises
    ------
    ValueError
        There are fewer than four complete frames.
    """
    full = fit_sensor_alignment("full", q_world_sensor, q_optical_body)
    if full.kappa <= MAX_KAPPA_FULL and full.weak_error <= MAX_WEAK_ERROR:
        return full
    no_full = (
        f"full world alignment: kappa {full.kappa:.3f} (at most {MAX_KAPPA_FULL}), standard error "
        f"in the least observable direction {np.rad2deg(full.weak_error):.2f} deg (at most "
        f"{np.rad2deg(MAX_WEAK_ERROR):.2g} deg): rotate about two or more axes"
    )

    heading = fit_sensor_alignment("heading", q_world_sensor, q_optical_body)
    if heading.kappa <= MAX_KAPPA_HEADING:
        return replace(heading, refused=(no_full,))
    no_heading = (
        f"heading alignment: kappa {heading.kappa:.3f} (at most {MAX_KAPPA_HEADING}): rotate "
        "about a horizontal axis, too"
    )
    mount = fit_sensor_alignment("mount", q_world_sensor, q_optical_body)
    return replace(mount, refused=(no_full, no_heading))


def fit_sensor_alignment(
    kind: AlignmentKind, q_world_sensor: ArrayLike, q_optical_body: ArrayLike
) -> SensorAlignment:
    r"""Fit one kind of alignment by robust least squares, without a check of its quality.

    With :math:`b = q_B` and :math:`v = q_W^*` the model is :math:`L(q_s) b = \pm R(q_{ref}) v`. L
    and R are the matrices of a quaternion product with the argument as left and right factor. The
    sum of squared differences over unit b and v is smallest at the first singular vectors of
    :math:`M = \sum w_i s_i T_i` with :math:`T_i = L(q_{s,i})^T R(q_{ref,i})`. The signs s and the
    Huber weights w are computed iteratively. For ``heading``, only the columns of M for the scalar
    and the z component of v are used. For ``mount``, q_W = 1 and q_B is a robust mean. Source: the
    quaternion form of AX = YB, Zhuang, Roth and Sudhakar 1994.

    Raises
    ------
    ValueError
        There are fewer than four complete frames.
    """
    q_s = rotation.normalize(q_world_sensor)
    q_ref = rotation.normalize(q_optical_body)
    both = np.isfinite(q_s).all(axis=1) & np.isfinite(q_ref).all(axis=1)
    if np.count_nonzero(both) < 4:
        raise ValueError("an alignment needs at least four frames with both orientations")
    q_s, q_ref = q_s[both], q_ref[both]

    if kind == "mount":
        q_mount = robust_mean(rotation.multiply(rotation.conjugate(q_s), q_ref)).q
        return _alignment_result(kind, (q_s, q_ref), rotation.IDENTITY, q_mount, 0.0)

    T = np.swapaxes(rotation.left_matrix(q_s), -1, -2) @ rotation.right_matrix(q_ref)

    # The fit starts from two guesses of the signs. One uses continuity in time, which outliers
    # interrupt. The other uses the similarity of the T_i.
    steady = np.where(np.sum(rotation.continuous(q_s) * q_s, axis=1) < 0.0, -1.0, 1.0)
    steady *= np.where(np.sum(rotation.continuous(q_ref) * q_ref, axis=1) < 0.0, -1.0, 1.0)
    flat = T.reshape(len(T), 16)
    alike = np.linalg.eigh(flat.T @ flat)[1][:, -1]
    starts = (steady, np.where(flat @ alike < 0.0, -1.0, 1.0))
    return min(
        (_solve(kind, q_s, q_ref, T[:, :, _columns(kind)], signs) for signs in starts),
        key=lambda found: found.residual_scale,
    )


def _solve(
    kind: AlignmentKind, q_s: Array, q_ref: Array, T: Array, signs: Array
) -> SensorAlignment:
    weights = np.ones(len(T))
    q_world, b, kappa = _decompose(kind, T, signs)

    for _ in range(MAX_PASSES):
        angles = rotation.angle_between(_model(q_world, q_s, b), q_ref)
        before = weights * signs
        signs = np.where(T @ rotation.conjugate(q_world)[_columns(kind)] @ b < 0.0, -1.0, 1.0)
        weights = huber_weights(angles, robust_scale(angles))
        q_world, b, kappa = _decompose(kind, T, weights * signs)
        if float(np.max(np.abs(weights * signs - before))) < SETTLED:
            break
    return _alignment_result(kind, (q_s, q_ref), q_world, b, kappa)


def _decompose(kind: AlignmentKind, T: Array, signed_weights: Array) -> tuple[Array, Array, float]:
    """Return q_W, q_B and kappa from the first singular vectors of the weighted sum of T_i."""
    U, S, Vt = np.linalg.svd(np.einsum("i,ijk->jk", signed_weights, T))
    v = np.zeros(4)
    v[_columns(kind)] = Vt[0]
    return rotation.conjugate(v), U[:, 0], float(S[1] / S[0])


def _columns(kind: AlignmentKind) -> list[int]:
    """Return the indices of the free components of v; a heading rotation has no x and y."""
    return [0, 3] if kind == "heading" else [0, 1, 2, 3]


def _model(q_world: Array, q_s: Array, q_mount: Array) -> Array:
    return rotation.multiply(q_world, rotation.multiply(q_s, q_mount))


def _alignment_result(
    kind: AlignmentKind, streams: tuple[Array, Array], q_world: Array, q_mount: Array, kappa: float
) -> SensorAlignment:
    q_s, q_ref = streams
    model = _model(q_world, q_s, q_mount)
    residuals = rotation.log(rotation.multiply(rotation.conjugate(model), q_ref))
    angles = np.linalg.norm(residuals, axis=1)
    rms, scale = float(np.sqrt(np.mean(angles**2))), robust_scale(angles)
    # Outliers have small weights in the fit, and therefore also in its standard error.
    weights = huber_weights(angles, scale)
    weighted_rms = float(np.sqrt(np.sum(weights**2 * angles**2) / np.sum(weights)))
    apart = effective_count(residuals * weights[:, None]) * (1.0 - kappa)
    weak = weighted_rms / np.sqrt(apart) if kappa < 1.0 - _SAME else np.inf
    q_world = rotation.align_hemisphere(q_world, rotation.IDENTITY)
    q_mount = rotation.align_hemisphere(q_mount, rotation.IDENTITY)
    return SensorAlignment(kind, q_world, q_mount, kappa, float(weak), rms, scale)
