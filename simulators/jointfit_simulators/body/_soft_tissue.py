"""Soft-tissue artefact: a repeatable part that depends on posture, and a random part.

One model serves rotations of sensors (rad) and displacements of markers (m).

Invariant: both parts are zero in upright stance. The repeatable part is a smooth function of the
adjacent joint angles; the random part is band-limited and scales with the same posture.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_simulators.body._limb import ANKLE, HIP, KNEE
from jointfit_simulators.body._random_signal import RandomSignal, random_vector_signal

if TYPE_CHECKING:
    from numpy.typing import NDArray

ADJACENT: dict[str, tuple[slice, ...]] = {
    "pelvis": (HIP,),
    "thigh": (HIP, KNEE),
    "shank": (KNEE, ANKLE),
    "foot": (ANKLE,),
}
"""Joints next to each part, as columns of a coordinate array."""

_WOBBLE_HZ = (0.3, 3.0)
_ROUNDING = 0.05


def _features(coordinates: NDArray[np.float64], joint: slice) -> NDArray[np.float64]:
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


def _rms_length(vectors: NDArray[np.float64]) -> float:
    """Return the RMS length of all vectors over time, shape (n, vectors, 3)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=-1))))


def _mixing(
    random: np.random.Generator,
    features: NDArray[np.float64],
    vectors: int,
    common_share: float,
) -> NDArray[np.float64]:
    """Return random directions for one joint's features; RMS length 1 over all vectors."""
    kinds = features.shape[1]
    together = random.standard_normal((kinds, 1, 3))
    together /= _rms_length(np.tensordot(features, together, 1))
    if vectors == 1:
        return together
    alone = random.standard_normal((kinds, vectors, 3))
    alone -= alone.mean(axis=1, keepdims=True)
    alone /= _rms_length(np.tensordot(features, alone, 1))
    mixed: NDArray[np.float64] = (
        np.sqrt(common_share) * together + np.sqrt(1 - common_share) * alone
    )
    return mixed


class SoftTissue:
    r"""Displacements of several points of one body part against its bone.

    .. math:: d(t) = \sum_j \Phi(\theta_j) C_j + g(\theta)\,n(t)

    with :math:`\Phi = (\sin f, 1-\cos f, \tfrac12\sin 2f, \sin a, \sin i)` of each adjacent joint
    *j*, random :math:`C_j`, band-limited noise *n* (0.3 to 3 Hz) and *g* the size of
    :math:`\Phi`. Scaled so that the RMS length over all vectors and the `reference` is `rms`.

    Parameters
    ----------
    random
        Dice for the directions and the noise.
    part
        Body part: a key of ADJACENT.
    vectors
        How many points (or sensors) move.
    rms
        RMS length over the reference, m or rad.
    random_share
        Share of the variance in the noise.
    knee_share
        Share of the repeatable variance driven by the knee, where the part has two joints.
    reference
        Coordinates of walking and squats, shape (n, COORDINATES).
    common_share
        Share of the variance in the movement of the middle of several vectors; the rest moves
        them about their middle.
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
        reference: NDArray[np.float64],
        common_share: float = 0.0,
    ) -> None:
        self._joints = ADJACENT[part]
        alone = len(self._joints) == 1
        shares = [
            1.0 if alone else knee_share if j is KNEE else 1 - knee_share for j in self._joints
        ]
        features = [_features(reference, joint) for joint in self._joints]
        self._gains = [
            share / np.mean(np.sum(found**2, axis=1))
            for share, found in zip(shares, features, strict=True)
        ]
        self._mixing = np.concatenate(
            [
                _mixing(random, found, vectors, common_share) * np.sqrt(share)
                for share, found in zip(shares, features, strict=True)
            ]
        )
        self._mixing *= rms * np.sqrt(1 - random_share) / _rms_length(self._repeatable(reference))
        size = np.sqrt(np.mean(self._size(reference) ** 2))
        wobble = rms * np.sqrt(random_share) / size
        single = vectors == 1
        self._together = _wobble(random, 1, wobble * np.sqrt(1.0 if single else common_share))
        spread = np.sqrt((1 - common_share) * vectors / max(vectors - 1, 1))
        self._alone = None if single else _wobble(random, vectors, wobble * spread)

    def _repeatable(self, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        features = np.concatenate([_features(coordinates, j) for j in self._joints], axis=1)
        found: NDArray[np.float64] = np.tensordot(features, self._mixing, 1)
        return found

    def _size(self, coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        square = np.full(len(coordinates), _ROUNDING**2)
        for gain, joint in zip(self._gains, self._joints, strict=True):
            square += gain * np.sum(_features(coordinates, joint) ** 2, axis=1)
        size: NDArray[np.float64] = np.sqrt(square) - _ROUNDING
        return size

    def at(self, t_s: NDArray[np.float64], coordinates: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the displacements, shape (n, vectors, 3), in the part's own axes."""
        found = self._repeatable(coordinates)
        wobble = self._together.at(t_s)[:, None, :]
        if self._alone is not None:
            alone = self._alone.at(t_s).reshape(len(t_s), -1, 3)
            wobble = wobble + alone - alone.mean(axis=1, keepdims=True)
        found += self._size(coordinates)[:, None, None] * wobble
        return found


def _wobble(random: np.random.Generator, vectors: int, rms: float) -> RandomSignal:
    return random_vector_signal(
        random, vectors, low_hz=_WOBBLE_HZ[0], high_hz=_WOBBLE_HZ[1], rms=rms
    )
