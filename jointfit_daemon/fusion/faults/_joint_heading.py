"""Monitoring of the relative heading of two neighboring segments that a hinge joint connects.

The flexion axis of a hinge is common to both segments. Its heading can be computed from either
segment, and the two results must agree. A slow drift of their difference is estimated by
:mod:`jointfit_daemon.fusion.faults._heading_drift`. A change within seconds is a fault and is
reported. The part of the change that other modules do not correct is added to the uncertainty.
"""

from __future__ import annotations

from math import exp, radians
from typing import TYPE_CHECKING

from jointfit_daemon.fusion.faults._heading_drift import HeadingDriftFilter
from jointfit_daemon.fusion.faults._slip import (
    MIN_LIMIT,
    SMOOTHING_S,
    USUAL_FACTOR,
    FaultDebouncer,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.limb_model import SensorLink

HINGE_SPREAD = radians(6.0)
"""Largest standard deviation of the heading between the flexion axes of both segments at a hinge,
rad. The part of this heading that depends on posture is removed first. At a joint with a larger
standard deviation, headings are not compared.
"""
LIMIT_SIGMA = 3.0
"""Heading difference at which two segments are inconsistent, in standard deviations of
the difference without a fault."""
RESIDUAL_SMOOTHING_S = 0.2
"""Time constant with which the heading difference after all corrections is smoothed, s. The
smoothed difference increases the uncertainty.
"""


class JointHeadingMonitor:
    """Monitors the headings of the two segments of one joint.

    Parameters
    ----------
    links : sequence of SensorLink
        Links between sensors of the two segments, from the calibration.
    standing : float
        Heading of the distal flexion axis relative to the proximal flexion axis in the static pose,
        rad.
    drifts : bool
        Whether a sensor of the joint has no heading reference. Its heading then drifts, even if no
        hinge makes the drift observable.
    """

    def __init__(self, links: Sequence[SensorLink], standing: float, *, drifts: bool) -> None:
        self.links = [link for link in links if link.spread <= HINGE_SPREAD]
        self.standing = standing
        self._uncertain = bool(self.links) or drifts
        """Whether the headings may drift; the drift is measured only if there are links."""
        spread = max((link.spread for link in self.links), default=HINGE_SPREAD)
        self.drift = HeadingDriftFilter(spread)
        self._sd = spread
        self._debouncer = FaultDebouncer()
        self._residual = self._corrected = 0.0
        self._before_ns: int | None = None
        self.difference = 0.0
        """Smoothed heading difference, without drift, rad. It is the difference of the pair of
        sensors that agrees best.
        """

    @property
    def inconsistent(self) -> bool:
        """Whether the headings contradict each other persistently."""
        return self._debouncer.active

    @property
    def extra_variance(self) -> float:
        """Variance of the heading between the segments beyond the calibration residuals, rad²."""
        drift2 = 0.0
        if self._uncertain:
            drift2 = max(0.0, self.drift.sd**2 - self.drift.observed_sd**2)
        excess = max(0.0, abs(self._residual) - USUAL_FACTOR * self._sd)
        return 0.5 * drift2 + excess * excess + self._corrected * self._sd * self._sd

    def update(self, t_ns: int, residual: float, uncorrected: float, sd: float) -> bool:
        """Add one measurement; return whether this measurement began or ended the inconsistency.

        Parameters
        ----------
        t_ns : int
            Instant of the frame.
        residual : float
            Heading difference after all corrections, rad.
        uncorrected : float
            Smallest heading difference of any pair of sensors before the corrections of magnetic
            disturbances, rad.
        sd : float
            Standard deviation of the difference without faults, rad.
        """
        if self._before_ns is None:
            self._before_ns = t_ns
        dt, self._before_ns, self._sd = (t_ns - self._before_ns) * 1e-9, t_ns, sd
        self._residual += (1.0 - exp(-dt / RESIDUAL_SMOOTHING_S)) * (residual - self._residual)
        self._corrected = min(abs(uncorrected - residual) / self._sd, 1.0)
        self.difference += (1.0 - exp(-dt / SMOOTHING_S)) * (uncorrected - self.difference)
        limit = max(MIN_LIMIT, LIMIT_SIGMA * sd)
        return self._debouncer.update(t_ns, abs(self.difference), limit)
