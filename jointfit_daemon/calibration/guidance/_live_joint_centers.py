r"""Joint centers during the movement, frame by frame, with their expected errors.

Two errors are reported separately. *Noise* decreases with the number of frames. It is the
covariance of the fit, increased for the correlation of the residuals in time. The error from
*soft-tissue artefact* depends on posture, so more frames do not reduce it. It decreases with a
larger arc, because a larger arc increases the matrix in brackets:

.. math:: \mathrm{Cov}_{skin} = \sigma_r^2 \Big[ \frac{1}{\sum_j n_j} \sum_j n_j
          \frac{\mathrm{Cov}(v_j)}{R_j^2} \Big]^{-1} + \sigma_s^2 I

where :math:`v_j` is marker j in coordinates of the proximal part, :math:`R_j` its distance from the
center, and :math:`n_j` its number of frames. :math:`\sigma_r` is `RADIAL_ARTEFACT_SD_M` and
:math:`\sigma_s` is `SKIN_SD_M` of `calibration.anatomy`. The fit after the movement uses the same
values and therefore predicts the same soft-tissue error. This fit has a smaller random error than
the estimate during the movement, because it compares the poses of both body parts instead of
fitting spheres.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import inf, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.anatomy import (
    MIN_DIRECTION_RAD,
    SKIN_SD_M,
    apply_standing_prior,
    on_skin,
    place_unobserved,
)
from jointfit_daemon.calibration.guidance._live_clusters import LiveClusters
from jointfit_daemon.center_of_rotation.spatial import RunningSphere, center_sums
from jointfit_daemon.limb_model import body_parts, branch_runs, joint_parts

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.center_of_rotation import CenterEstimate
    from jointfit_daemon.center_of_rotation.spatial import SphereLimits
    from jointfit_daemon.limb_model import MarkerCluster
    from jointfit_daemon.model import Chain, MocapFrame


_ROUNDED_M2 = 1e-12
"""Lower bound of squared radii, m², which prevents a division by zero."""
_ALONG = 0.7
"""Cosine of the angle to an unobserved direction of the estimator. A direction with a larger
absolute cosine also counts as unobserved.
"""


@dataclass(frozen=True, slots=True)
class LiveJointCenter:
    """Current estimate of one joint center. No value is NaN."""

    joint: str
    center: Array | None
    """Position in the optical world during the static pose, m, shape (3,); None without an
    estimate."""
    noise: float
    """Random error, m: root mean variance of the observed directions; inf if fewer than two
    directions were observed.
    """
    noise_across: float
    """Random error in the two most certain directions, m. The movement of a hinge determines only
    these directions.
    """
    total: float
    """Total error, m, as standard deviation per axis, including soft-tissue artefact. In unobserved
    directions, the error follows from the static pose. A calibration stores this value.
    """
    arc: float
    """Range of the marker directions about the center, rad."""
    conditioning: float
    """Ratio of the radius to the standard deviation in the least certain direction. Below 6 the
    center is rejected.
    """
    frames: int
    """Number of frames with the pose of the proximal body part and a marker of the distal one."""
    unseen: int
    """Number of unobserved directions, 0 to 3."""
    refused: str | None
    """Reason why the estimator rejected or did not determine the center; None if it accepted the
    center."""


class LiveJointCenters:
    """Centers of all joints with markers on both body parts, one camera frame at a time.

    Parameters
    ----------
    chain : Chain
        Joints, segments and adjacent body parts.
    clusters : mapping of str to MarkerCluster
        Body parts in the static pose; parts without markers are absent.
    limits
        Acceptance limits of `RunningSphere`.
    """

    def __init__(
        self,
        chain: Chain,
        clusters: Mapping[str, MarkerCluster],
        *,
        limits: SphereLimits | None = None,
    ) -> None:
        self._chain = chain
        self.parts = LiveClusters(clusters)
        place = {name: i for i, name in enumerate(self.parts.names)}
        ends = body_parts(chain)
        pairs = [
            (joint, place[above], place[below])
            for joint, above, below in (
                (name, ends[a], ends[b])
                for name, (a, b) in zip(chain.joints, joint_parts(chain), strict=True)
            )
            if above is not None and below is not None and {above, below} <= place.keys()
        ]
        self.joints = tuple(joint for joint, _, _ in pairs)
        self._parents = np.array([above for _, above, _ in pairs], dtype=np.intp)
        self._children = np.array([below for _, _, below in pairs], dtype=np.intp)
        self._home = self.parts.origins[self._parents][:, None]
        self._sizes = [self.parts.sizes[i] for i in self._children]

        starts = (self.parts.origins[self._parents] + self.parts.origins[self._children]) / 2
        self._spheres = [
            RunningSphere(size, near=start, limits=limits)
            for size, start in zip(self._sizes, starts, strict=True)
        ]
        self._frames = np.zeros(len(pairs), dtype=np.int64)
        self._latest: dict[str, tuple[LiveJointCenter, CenterEstimate | None]] = {
            joint: (_unknown(joint, 0, 0.0, 3, "no frame yet"), None) for joint in self.joints
        }
        self._turn = -1

    def fade(self, share: float) -> None:
        """Multiply the weights of all frames that were processed by a factor between 0 and 1."""
        for sphere in self._spheres:
            sphere.fade(share)

    def feed(self, frame: MocapFrame) -> None:
        """Process the markers of the distal parts relative to the proximal parts in one frame."""
        parts = self.parts
        parts.feed(frame)
        if not self.joints:
            return

        # Markers of the distal parts in static-world coordinates of the proximal parts.
        above = self._parents
        v = (parts.points[self._children] - parts.p[above][:, None]) @ parts.R[above]
        v[~parts.placed[above]] = np.nan
        v += self._home

        some = np.asarray(np.isfinite(v[..., 0]).any(axis=1))
        self._frames += some
        for k, sphere in enumerate(self._spheres):
            if some[k]:
                sphere.feed(v[k, : self._sizes[k]])

    def estimate_next(self) -> tuple[LiveJointCenter, CenterEstimate | None]:
        """Estimate the center of the next joint in turn.

        The second result is the fit, or None if fewer than two directions were observed.
        """
        k = self._turn = (self._turn + 1) % len(self.joints)
        with np.errstate(all="ignore"):  # markers at rest cause divisions by zero
            estimate = self._spheres[k].estimate()
        found = self._latest[self.joints[k]] = self._observed_estimate(k, estimate)
        return found

    def estimate_centers(self) -> dict[str, LiveJointCenter]:
        """Return the current estimates; call a few times per second, not in every frame.

        An estimate takes a thousand times as long as `feed`. Each call therefore fits only one
        joint, and successive calls fit the joints in turn.
        """
        if self.joints:
            self.estimate_next()

        # Unobserved directions and the standing prior need the estimates of all joints.
        fits = {joint: fit for joint, (_, fit) in self._latest.items() if fit is not None}
        settled = place_unobserved(self._chain, fits)

        placed: dict[str, tuple[Array, Array] | None] = {}
        for run in branch_runs(self._chain):
            order = [self._chain.joints[i] for i in run]
            straight = apply_standing_prior(
                [settled[j].center if j in settled else None for j in order],
                [on_skin(settled[j]) if j in settled else None for j in order],
            )
            placed |= zip(order, straight, strict=True)
        found = {joint: one for joint, (one, _) in self._latest.items()}
        for joint, one in found.items():
            if (pair := placed[joint]) is not None:
                center, covariance = pair
                total = sqrt(max(float(np.trace(covariance)), 0.0) / 3.0 + SKIN_SD_M**2)
                found[joint] = replace(one, center=center, total=total)
        return found

    def _observed_estimate(
        self, k: int, fit: CenterEstimate
    ) -> tuple[LiveJointCenter, CenterEstimate | None]:
        """Return an estimate in which directions with hardly any rotation count as unobserved.

        The second result is the fit in the observed directions, or None if there are fewer than
        two.
        """
        joint, frames = self.joints[k], int(self._frames[k])
        center = np.asarray(fit.center, dtype=np.float64)
        shown, axes, clear = np.zeros((3, 3)), np.eye(3), np.zeros(3, dtype=np.bool_)
        if len(fit.unseen) < 2 and np.isfinite(center).all():
            # The mean square change of the marker directions, rad², shape (3, 3).
            sums = center_sums(self._spheres[k].sums())
            n = sums.weights
            turned = (
                np.einsum("jajb->jab", sums.M[:, 1:-1, :, 1:-1]) / np.maximum(n, 1.0)[:, None, None]
            )
            radius2 = ((sums.origin - center) ** 2).sum(axis=1) + np.einsum("jaa->j", turned)
            weight = n / np.maximum(radius2, _ROUNDED_M2)
            shown = np.asarray(np.einsum("j,jab->ab", weight, turned) / max(float(n.sum()), 1.0))
            spread, axes = np.linalg.eigh(shown)
            clear = np.asarray(spread >= MIN_DIRECTION_RAD**2)
            for axis in fit.unseen:
                clear &= np.abs(axes.T @ axis) < _ALONG

        # Restrict covariance and leverage to the observed directions.
        basis, unseen = axes[:, clear], 3 - int(clear.sum())
        if unseen > 1:
            reason = fit.refused or "the joint has hardly turned"
            return _unknown(joint, frames, _finite(fit.arc), max(unseen, 2), reason), None
        own = basis.T @ fit.covariance @ basis
        lever = basis @ np.linalg.inv(basis.T @ shown @ basis) @ basis.T
        rest = axes[:, ~clear].T
        variances = np.maximum(np.linalg.eigvalsh(own), 0.0)

        one = LiveJointCenter(
            joint, center, sqrt(float(variances.mean())), sqrt(float(variances[:2].mean())), inf,
            _finite(fit.arc), _finite(fit.conditioning), frames, unseen, fit.refused,
        )  # fmt: skip
        observed = basis @ own @ basis.T
        axis = rest[0] if len(rest) == 1 else None
        return one, replace(
            fit, center=center, covariance=observed, unseen=rest, axis=axis, leverage=lever
        )


def _finite(value: float) -> float:
    return float(value) if np.isfinite(value) else 0.0


def _unknown(joint: str, frames: int, arc: float, unseen: int, reason: str) -> LiveJointCenter:
    return LiveJointCenter(joint, None, inf, inf, inf, arc, 0.0, frames, unseen, reason)
