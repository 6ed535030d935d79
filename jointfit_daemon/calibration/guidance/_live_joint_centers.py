r"""Joint centers while the wearer still moves: frame by frame, with the error to be expected.

Law: two errors, never one for the other. *Noise* is what more frames average away: the covariance
of the fit, widened for residuals that persist from frame to frame. *Skin* moves with posture, so no
number of frames averages it away: only a larger arc makes it small, through the leverage

.. math:: \mathrm{Cov}_{skin} = \sigma_r^2 \Big[ \frac{1}{\sum_j n_j} \sum_j n_j
          \frac{\mathrm{Cov}(v_j)}{R_j^2} \Big]^{-1} + \sigma_s^2 I

with :math:`v_j` marker j in the parent's coordinates at distance :math:`R_j` from the center. The
constants and the rest of the arithmetic are those of the fit that follows, so that the prediction
is the one the fit will make.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.anatomy import (
    MIN_DIRECTION_RAD,
    SKIN_SD_M,
    UNSEEN_SD_M,
    CenterOfRotation,
    on_skin,
    settle_unseen,
    stand_straight,
)
from jointfit_daemon.calibration.guidance._live_clusters import LiveParts
from jointfit_daemon.center_of_rotation.spatial import RunningSphere, centered
from jointfit_daemon.limb_model import body_parts

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation import CenterEstimate
    from jointfit_daemon.limb_model import Cluster
    from jointfit_daemon.model import Chain, MocapFrame


_ROUNDED_M2 = 1e-12
_ALONG = 0.7
"""Cosine from which a direction counts for one that the estimator has not seen."""


@dataclass(frozen=True, slots=True)
class LiveCenter:
    """One joint center as far as it is known by now. Nothing in it is NaN."""

    joint: str
    center: Array | None
    """Static world, m, shape (3,); None while there is none."""
    noise: float
    """Standard deviation by noise, m: root of the mean variance of the directions observed; inf
    while there are none."""
    noise_across: float
    """The same without the direction known least: all that a hinge can show."""
    total: float
    """Standard deviation per axis with skin motion and what the static pose says of unseen
    directions, m: the figure that a calibration stores."""
    arc: float
    """Angle the markers went through about the center, rad."""
    conditioning: float
    """Radius over the standard deviation along the direction known least: below 6 it is none."""
    frames: int
    """Frames that showed both body parts."""
    unseen: int
    """Directions that the movement has not shown, 0 to 3."""
    refused: str | None
    """Why there is no center yet, as the estimator has it."""


class LiveCenters:
    """Centers of all joints whose two body parts carry markers, one camera frame at a time.

    Parameters
    ----------
    chain : Chain
        Joints, segments and the body parts beside them.
    clusters : mapping of str to Cluster
        The body parts as they stood in the static pose; parts without markers are absent.
    """

    def __init__(self, chain: Chain, clusters: Mapping[str, Cluster]) -> None:
        self._chain = chain
        self.parts = LiveParts(clusters)
        place = {name: i for i, name in enumerate(self.parts.names)}
        ends = body_parts(chain)
        pairs = [
            (joint, place[above], place[below])
            for joint, above, below in zip(chain.joints, ends, ends[1:], strict=False)
            if above is not None and below is not None and {above, below} <= place.keys()
        ]
        self.joints = tuple(joint for joint, _, _ in pairs)
        self._parents = np.array([above for _, above, _ in pairs], dtype=np.intp)
        self._children = np.array([below for _, _, below in pairs], dtype=np.intp)
        self._home = self.parts.origins[self._parents][:, None]
        self._sizes = [self.parts.sizes[i] for i in self._children]
        starts = (self.parts.origins[self._parents] + self.parts.origins[self._children]) / 2
        self._spheres = [
            RunningSphere(size, near=start) for size, start in zip(self._sizes, starts, strict=True)
        ]
        self._frames = np.zeros(len(pairs), dtype=np.int64)
        self._told: dict[str, tuple[LiveCenter, CenterOfRotation | None]] = {
            joint: (_unknown(joint, 0, 0.0, 3, "no frame yet"), None) for joint in self.joints
        }
        self._turn = -1

    def feed(self, frame: MocapFrame) -> None:
        """Take one frame: every marker of a joint's lower part as its upper part sees it."""
        parts = self.parts
        parts.feed(frame)
        if not self.joints:
            return
        above = self._parents
        v = (parts.points[self._children] - parts.p[above][:, None]) @ parts.R[above]
        v[~parts.placed[above]] = np.nan
        v += self._home
        some = np.asarray(np.isfinite(v[..., 0]).any(axis=1))
        self._frames += some
        for k, sphere in enumerate(self._spheres):
            if some[k]:
                sphere.feed(v[k, : self._sizes[k]])

    def look(self) -> dict[str, LiveCenter]:
        """Return every center as known by now; for a few times a second, not for every frame.

        Estimating costs a thousand times what a frame does, so each look takes up one joint anew,
        in turn.
        """
        if self.joints:
            k = self._turn = (self._turn + 1) % len(self.joints)
            with np.errstate(all="ignore"):  # of markers that stand still little is left but zeros
                found = self._spheres[k].estimate()
            self._told[self.joints[k]] = self._judged(k, found)
        fits = {joint: fit for joint, (_, fit) in self._told.items() if fit is not None}
        settled = settle_unseen(self._chain, fits)
        order = self._chain.joints
        straight = stand_straight(
            [settled[j].center if j in settled else None for j in order],
            [on_skin(settled[j]) if j in settled else None for j in order],
        )
        placed = dict(zip(order, straight, strict=True))
        return {joint: _placed(one, placed[joint]) for joint, (one, _) in self._told.items()}

    def _judged(self, k: int, fit: CenterEstimate) -> tuple[LiveCenter, CenterOfRotation | None]:
        """Return what a fit shows on skin, where a direction that hardly turned shows nothing."""
        joint, frames = self.joints[k], int(self._frames[k])
        center = np.asarray(fit.center, dtype=np.float64)
        shown, axes, clear = np.zeros((3, 3)), np.eye(3), np.zeros(3, dtype=np.bool_)
        if len(fit.unseen) < 2 and np.isfinite(center).all():
            shown = self._shown(k, center)
            spread, axes = np.linalg.eigh(shown)
            clear = np.asarray(spread >= MIN_DIRECTION_RAD**2)
            for axis in fit.unseen:
                clear &= np.abs(axes.T @ axis) < _ALONG
        basis, unseen = axes[:, clear], 3 - int(clear.sum())
        if unseen > 1:
            reason = fit.refused or "the joint has hardly turned"
            return _unknown(joint, frames, _finite(fit.arc), max(unseen, 2), reason), None
        own = basis.T @ fit.covariance @ basis
        lever = basis @ np.linalg.inv(basis.T @ shown @ basis) @ basis.T
        rest = axes[:, ~clear].T
        covariance = basis @ own @ basis.T + UNSEEN_SD_M**2 * rest.T @ rest
        variances = np.maximum(np.linalg.eigvalsh(own), 0.0)
        one = LiveCenter(
            joint, center, sqrt(float(variances.mean())), sqrt(float(variances[:2].mean())), inf,
            _finite(fit.arc), _finite(fit.conditioning), frames, unseen, fit.refused,
        )  # fmt: skip
        found = CenterOfRotation(
            center, covariance, _finite(fit.residual), frames, one.arc, rest, lever, fit.refused
        )
        return one, found

    def _shown(self, k: int, center: Array) -> Array:
        """Return the mean square change of the markers' directions, rad², shape (3, 3)."""
        sums = centered(self._spheres[k].sums())
        n = sums.weights
        spread = (
            np.einsum("jajb->jab", sums.M[:, 1:-1, :, 1:-1]) / np.maximum(n, 1.0)[:, None, None]
        )
        radius2 = ((sums.origin - center) ** 2).sum(axis=1) + np.einsum("jaa->j", spread)
        weight = n / np.maximum(radius2, _ROUNDED_M2)
        return np.asarray(np.einsum("j,jab->ab", weight, spread) / max(float(n.sum()), 1.0))


def _finite(value: float) -> float:
    return float(value) if np.isfinite(value) else 0.0


def _unknown(joint: str, frames: int, arc: float, unseen: int, reason: str) -> LiveCenter:
    return LiveCenter(joint, None, inf, inf, inf, arc, 0.0, frames, unseen, reason)


def _placed(one: LiveCenter, pair: tuple[Array, Array] | None) -> LiveCenter:
    """Return a center with what the others and the static pose say of it."""
    if pair is None:
        return one
    total = sqrt(max(float(np.trace(pair[1])), 0.0) / 3.0 + SKIN_SD_M**2)
    return replace(one, center=pair[0], total=total)
