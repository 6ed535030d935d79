"""Soft-tissue artefact, with a repeatable part that depends on posture, and a random part.

The same model is used for rotations of sensors (rad) and displacements of markers (m).

Invariant: both parts are zero in upright stance. The repeatable part is a smooth function of the
adjacent joint angles. The random part is band-limited, and its magnitude depends on the same
angles.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from jointfit_simulators.body._limb import ANKLE, HIP, KNEE, LEFT_KNEE
from jointfit_simulators.body._random_signal import random_vector_signal

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array

ADJACENT: dict[str, tuple[slice, ...]] = {
    "pelvis": (HIP,),
    "thigh": (HIP, KNEE),
    "shank": (KNEE, ANKLE),
    "foot": (ANKLE,),
}
"""Columns of the joints adjacent to each part of the leg, in a coordinate array."""

_NOISE_HZ = (0.3, 3.0)
"""Frequency band of the random part, Hz."""
_ROUNDING = 0.05
"""Smoothing of the posture magnitude near upright stance, where its derivative is undefined."""


def _features(coordinates: Array, joint: slice) -> Array:
    flexion, adduction, rotation = coordinates[:, joint].T
    return np.column_stack(
        (
            np.sin(flexion),
            1 - np.cos(flexion),
            np.sin(2 * flexion) / 2,
            np.sin(adduction),
            np.sin(rotation),
        )
    )


def _rms_length(vectors: Array) -> float:
    """Return the RMS length of all vectors over time, shape (n, vectors, 3)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))


def _mixing(
    random: np.random.Generator, features: Array, vectors: int, common_share: float
) -> Array:
    """Return random directions for the features of a joint; displacements have RMS length 1."""
    kinds = features.shape[1]
    common = random.standard_normal((kinds, 1, 3))
    common /= _rms_length(np.tensordot(features, common, 1))
    if vectors == 1:
        return common

    single = random.standard_normal((kinds, vectors, 3))
    single -= single.mean(axis=1, keepdims=True)
    single /= _rms_length(np.tensordot(features, single, 1))
    mixed: Array = np.sqrt(common_share) * common + np.sqrt(1 - common_share) * single
    return mixed


class SoftTissue:
    r"""Displacements of several points of one body part relative to its bone.

    .. math:: d(t) = \sum_j \Phi(\theta_j) C_j + g(\theta)\,n(t)

    Each adjacent joint *j* has the angles :math:`\theta_j = (f, a, i)`: flexion, adduction and
    internal rotation. Its features are
    :math:`\Phi = (\sin f, 1-\cos f, \tfrac12\sin 2f, \sin a, \sin i)`. The matrix :math:`C_j` is
    random. *n* is band-limited noise (0.3 to 3 Hz). Its factor :math:`g(\theta)` is the weighted
    magnitude of the features of all adjacent joints. Both terms are scaled so that the RMS length
    of *d* over all points and the `reference` is `rms`.

    Parameters
    ----------
    random
        Random generator of the directions and the noise.
    part
        Body part, a key of `adjacent`.
    vectors
        Number of points (or sensors).
    rms
        RMS length over the reference, m or rad.
    random_share
        Share of the variance that the noise causes.
    knee_share
        Share of the repeatable variance that the second joint of the limb (the knee) causes, for
        parts with two joints.
    reference
        Coordinates of the reference motions of the limb, shape (n, COORDINATES).
    common_share
        Share of the variance that the mean displacement of all points causes. The remainder moves
        the points relative to their mean.
    adjacent
        Columns of the joints adjacent to each part.
    """

    def __init__(
        self,
        random: np.random.Generator,
        part: str,
        vectors: int,
        *,
        rms: float,
        random_share: float,
        knee_share: float,
        reference: Array,
        common_share: float = 0.0,
        adjacent: Mapping[str, tuple[slice, ...]] = ADJACENT,
    ) -> None:
        self._joints = adjacent[part]
        one_joint = len(self._joints) == 1
        shares = [
            1.0 if one_joint else knee_share if j in (KNEE, LEFT_KNEE) else 1 - knee_share
            for j in self._joints
        ]
        features = [_features(reference, joint) for joint in self._joints]

        # Repeatable part, scaled to its RMS over the reference.
        self._gains = [
            share / np.mean(np.sum(values**2, axis=1))
            for share, values in zip(shares, features, strict=True)
        ]
        self._mixing = np.concatenate(
            [
                _mixing(random, values, vectors, common_share) * np.sqrt(share)
                for share, values in zip(shares, features, strict=True)
            ]
        )
        self._mixing *= rms * np.sqrt(1 - random_share) / _rms_length(self._repeatable(reference))

        # Random part. Subtracting the mean of k vectors reduces their variance by the factor (k -
        # 1) / k.
        magnitude = np.sqrt(np.mean(self._magnitude(reference) ** 2))
        noise_rms = rms * np.sqrt(random_share) / magnitude
        noise = partial(random_vector_signal, random, low_hz=_NOISE_HZ[0], high_hz=_NOISE_HZ[1])
        self._common = noise(1, rms=noise_rms * np.sqrt(1.0 if vectors == 1 else common_share))
        spread = np.sqrt((1 - common_share) * vectors / max(vectors - 1, 1))
        self._single = None if vectors == 1 else noise(vectors, rms=noise_rms * spread)

    def _repeatable(self, coordinates: Array) -> Array:
        features = np.concatenate([_features(coordinates, j) for j in self._joints], axis=1)
        displacements: Array = np.tensordot(features, self._mixing, 1)
        return displacements

    def _magnitude(self, coordinates: Array) -> Array:
        square = np.full(len(coordinates), _ROUNDING**2)
        for gain, joint in zip(self._gains, self._joints, strict=True):
            square += gain * np.sum(_features(coordinates, joint) ** 2, axis=1)
        magnitude: Array = np.sqrt(square) - _ROUNDING
        return magnitude

    def at(self, t_s: Array, coordinates: Array) -> Array:
        """Return the displacements, shape (n, vectors, 3), in the frame of the part."""
        noise = self._common.at(t_s)[:, None, :]
        if self._single is not None:
            single = self._single.at(t_s).reshape(len(t_s), -1, 3)
            noise = noise + single - single.mean(axis=1, keepdims=True)
        return self._repeatable(coordinates) + self._magnitude(coordinates)[:, None, None] * noise
