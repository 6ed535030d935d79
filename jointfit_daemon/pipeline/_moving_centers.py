"""Continuous estimates of joint centers after calibration, and a test of their shift.

Invariant: only live mocap frames change the estimates, and limb states do not depend on the
estimates.
"""

from __future__ import annotations

from math import erfc, exp, pi, sqrt
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.anatomy import posture_covariance
from jointfit_daemon.calibration.guidance import LiveJointCenters
from jointfit_daemon.center_of_rotation.spatial import SphereLimits
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import body_parts, joint_parts, restore_cluster, vector
from jointfit_daemon.model import RunningCenter, RunningCenters
from jointfit_daemon.timing.alignment import RateDivider

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.guidance import LiveJointCenter
    from jointfit_daemon.center_of_rotation import CenterEstimate
    from jointfit_daemon.limb_model import CalibratedCenter, Calibration
    from jointfit_daemon.model import Chain, MocapFrame, Vector

RATE_HZ = 20.0
"""Number of camera frames per second that are used. Joints rotate by a few degrees between two of
these frames."""
PUBLISHED_HZ = 1.0
"""Number of published results per second."""
MOVED_P = 1e-4
"""Probability of a shift by chance, below which a center is reported as moved.

In one hour with a time constant of 20 s, 180 independent estimates are tested."""
_UNSEEN_SD_M = 1.0
"""Standard deviation along an unobserved direction, m; it exceeds the size of any limb."""
_SAME_DIRECTION = 0.3
"""Largest singular value of a direction that counts as observed by both centers.

The singular values are those of a matrix. Its rows are the directions that the running center did
not observe, and the directions that the calibrated center did not observe. If a row of one center
nearly equals a row of the other, the two rows have one large and one small singular value."""


class MovingCenters:
    r"""Estimates the center of every joint from the last frames, and tests its shift.

    The running center of a joint is the estimate from the last frames. At the time t, a frame of
    the time t_k has the weight :math:`e^{-(t - t_k)/T}`. The shift δ between running and calibrated
    center is tested with the covariances C of both centers,

    .. math:: D^2 = \delta^T (C + C_{calibrated})^{-1} \delta \sim \chi^2_r,

    over the r directions that were observed both by the calibration movement and by the recent
    movement. Residuals from soft-tissue artefact repeat with posture. In the calibrated and in the
    published covariance, all frames together count as one observation of these residuals. The
    artefact displaces both centers alike, so the test must count it once. For the running center,
    the test therefore uses only the covariance of the random error as C.

    Parameters
    ----------
    chain : Chain
        The limb.
    calibration : Calibration or None
        The current calibration. Without a calibration, nothing is estimated.
    memory_s : float
        Time constant T, s; 0 disables the estimates.
    """

    def __init__(self, chain: Chain, calibration: Calibration | None, memory_s: float) -> None:
        self._memory_s = memory_s
        self._inputs: object = (
            None
            if calibration is None
            else (
                chain,
                memory_s,
                calibration.clusters,
                calibration.joint,
                {name: item.q_static for name, item in calibration.segment.items()},
            )
        )
        self._centers: LiveJointCenters | None = None
        if calibration is None or not calibration.fits(chain) or not memory_s > 0.0:
            return
        self._calibration = calibration
        clusters = {name: restore_cluster(name, c) for name, c in calibration.clusters.items()}
        self._centers = LiveJointCenters(chain, clusters, limits=SphereLimits())
        parts = body_parts(chain)
        above = {j: parts[k] for j, (k, _) in zip(chain.joints, joint_parts(chain), strict=True)}
        self._segments = [above[joint] or "" for joint in self._centers.joints]
        self._frames = RateDivider(RATE_HZ)
        self._turns = RateDivider(PUBLISHED_HZ * max(len(self._segments), 1))
        self._latest: list[tuple[RunningCenter, CenterEstimate | None]] = []
        self._before_ns: int | None = None
        self._seen: dict[str, tuple[int, int]] = {}
        """Number of frames that show both body parts of a joint, and stamp of the last such frame,
        ns."""

    def serves(self, other: MovingCenters) -> bool:
        """Return whether this object has the same inputs as `other`, a new object."""
        return self._inputs == other._inputs

    def add_frame(self, t_ns: int, frame: MocapFrame) -> list[RunningCenters]:
        """Add one live mocap frame with its stamp; return the centers about once a second.

        Each call estimates at most one joint, so that no limb frame waits for all joints.
        """
        centers = self._centers
        if centers is None or not centers.joints or not self._frames.is_due(t_ns):
            return []
        if self._before_ns is not None:
            elapsed_s = max(t_ns - self._before_ns, 0) * 1e-9
            centers.fade(exp(-elapsed_s / self._memory_s))
        self._before_ns = t_ns
        centers.feed(frame)
        if not self._turns.is_due(t_ns):
            return []
        live, fit = centers.estimate_next()
        self._latest.append((self._compare(t_ns, centers, live, fit), fit))
        if len(self._latest) < len(self._segments):
            return []
        found = tuple(self._add_positions(centers, one, fit) for one, fit in self._latest)
        self._latest = []
        return [RunningCenters(t_ns, self._memory_s, found)]

    @staticmethod
    def _add_positions(
        centers: LiveJointCenters, found: RunningCenter, fit: CenterEstimate | None
    ) -> RunningCenter:
        """Add the joint's position, computed from the markers in the newest frame."""
        parts = centers.parts
        number = parts.names.index(found.segment)
        if fit is None or found.center is None or not parts.placed[number]:
            return found
        away = fit.center - parts.origins[number]
        return found._replace(position=vector(parts.R[number] @ away + parts.p[number]))

    def _compare(
        self,
        t_ns: int,
        centers: LiveJointCenters,
        live: LiveJointCenter,
        fit: CenterEstimate | None,
    ) -> RunningCenter:
        segment = self._segments[centers.joints.index(live.joint)]
        frames, seen_ns = self._seen.get(live.joint, (-1, t_ns))
        if live.frames != frames:
            self._seen[live.joint] = live.frames, t_ns
        elif (hidden_s := (t_ns - seen_ns) * 1e-9) > self._memory_s:
            refused = f"its markers have been hidden for {hidden_s:.0f} s"
            return RunningCenter(live.joint, segment, live.arc, refused)
        found = RunningCenter(live.joint, segment, live.arc, live.refused)
        if fit is None or fit.refused is not None:
            return found._replace(refused=live.refused or "the joint has hardly turned")

        # The origin of the segment is the mean of its markers, with the axes of the calibration.
        parts = centers.parts
        item = self._calibration.segment.get(segment)
        turn = np.eye(3) if item is None else rotation.to_matrix(np.array(item.q_static)).T

        a, b, c = turn @ posture_covariance(fit) @ turn.T
        found = found._replace(
            center=vector(turn @ (fit.center - parts.origins[parts.names.index(segment)])),
            covariance=(vector(a), vector(b), vector(c)),
            unseen=tuple(_signed(turn @ direction) for direction in fit.unseen),
            axis=None if fit.axis is None else _signed(turn @ fit.axis),
            effective_frames=fit.effective_frames,
        )
        reference = self._calibration.joint[live.joint].rotation
        if reference is None:
            return found
        shift, chance = _shift_test(fit, reference)
        if shift is None:
            return found
        return found._replace(shift=vector(turn @ shift), p_value=chance, moved=chance < MOVED_P)


def _signed(direction: Array) -> Vector:
    """Return a direction with the sign for which its largest component is positive."""
    return vector(direction * np.sign(direction[np.argmax(np.abs(direction))]))


def _shift_test(fit: CenterEstimate, reference: CalibratedCenter) -> tuple[Array | None, float]:
    """Return the shift along the directions observed for both centers, m, and its chance.

    The chance is the probability of a larger shift by random errors. Without a common direction,
    the result is None and 1.
    """
    unseen = np.concatenate((fit.unseen.reshape(-1, 3), np.reshape(reference.unseen, (-1, 3))))
    size, axes = np.linalg.svd(unseen, full_matrices=False)[1:]
    hidden = axes[size > _SAME_DIRECTION]
    if (observed := 3 - len(hidden)) == 0:
        return None, 1.0

    shift = fit.center - np.array(reference.center)
    covariance = fit.covariance + np.array(reference.covariance)
    covariance = covariance + _UNSEEN_SD_M**2 * unseen.T @ unseen
    square = float(shift @ np.linalg.solve(covariance, shift))
    return shift - hidden.T @ (hidden @ shift), chance_of(square, observed)


def chance_of(square: float, freedom: int) -> float:
    r"""Return the probability that chi-squared with `freedom` degrees of freedom exceeds `square`.

    With x = `square` and 1, 2 or 3 degrees of freedom, the probability is

    .. math:: p_1 = \mathrm{erfc}\sqrt{x/2}, \quad p_2 = e^{-x/2}, \quad
              p_3 = p_1 + \sqrt{2x/\pi}\, e^{-x/2}
    """
    x = max(square, 0.0)
    tail = exp(-x / 2.0)
    if freedom == len("xy"):
        return tail
    single = erfc(sqrt(x / 2.0))
    return single if freedom == 1 else min(1.0, single + sqrt(2.0 * x / pi) * tail)
