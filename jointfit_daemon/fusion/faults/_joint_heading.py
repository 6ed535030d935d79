"""Tells whether the headings of two neighboring segments agree, where a hinge ties them.

Law: pure, O(1) a look. Drift is followed slowly (``heading_drift``); what comes within seconds is
doubted and, as far as it is not taken out elsewhere, claimed as uncertainty.
"""

from __future__ import annotations

from math import exp, radians
from typing import TYPE_CHECKING

from jointfit_daemon.fusion.faults._heading_drift import HeadingDrift
from jointfit_daemon.fusion.faults._slip import LEAST_LIMIT, SMOOTH_S, USUAL, LastingDoubt

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.limb_model import SensorLink

HINGE_SPREAD = radians(6.0)
"""A joint whose flexion axes turn against each other by more than this, posture aside, is no hinge:
nothing about headings is read from it."""
LIMIT = 3.0
"""Headings apart, in standard deviations of a look, from which on they contradict each other."""
LEFT_S = 0.2
"""Smoothing of what is left after all is taken out: it goes into the deviation."""


class JointWatch:
    """Watches one joint.

    Parameters
    ----------
    links : sequence of SensorLink
        Between the sensors of the two segments, as calibration saw them.
    standing : float
        Heading of the distal flexion axis against the proximal one in the static pose, rad.
    drifts : bool
        Whether a sensor is known to have no north: then a drift goes on unseen without a hinge.
    """

    def __init__(self, links: Sequence[SensorLink], standing: float, *, drifts: bool) -> None:
        self.links = [link for link in links if link.spread <= HINGE_SPREAD]
        self.standing = standing
        self.known = bool(self.links) or drifts
        """Whether the drift is looked at, or known to go on unseen."""
        spread = max((link.spread for link in self.links), default=HINGE_SPREAD)
        self.drift = HeadingDrift(spread)
        self._sd = spread
        self._doubt = LastingDoubt()
        self._left = self._taken = 0.0
        self._before_ns: int | None = None
        self.apart = 0.0
        """Smoothed distance of the headings whoever is odd on either segment, drift aside, rad."""

    @property
    def doubtful(self) -> bool:
        """Whether the headings contradict each other for good."""
        return self._doubt.doubtful

    @property
    def extra2(self) -> float:
        """Variance of the heading between the segments beyond what calibration saw, rad²."""
        drift2 = max(0.0, self.drift.sd**2 - self.drift.least_sd**2) if self.known else 0.0
        excess = max(0.0, abs(self._left) - USUAL * self._sd)
        return 0.5 * drift2 + excess * excess + self._taken * self._sd * self._sd

    def look(self, t_ns: int, left: float, turned: float, sd: float) -> bool:
        """Take one look; return whether the doubt began or ended with it.

        Parameters
        ----------
        t_ns : int
            Instant.
        left : float
            Heading error after all corrections, rad.
        turned : float
            The same before sudden turns were taken out, of those sensors who agree best, rad.
        sd : float
            Standard deviation of a healthy look, rad.
        """
        if self._before_ns is None:
            self._before_ns = t_ns
        dt, self._before_ns, self._sd = (t_ns - self._before_ns) * 1e-9, t_ns, sd
        self._left += (1.0 - exp(-dt / LEFT_S)) * (left - self._left)
        self._taken = min(abs(turned - left) / self._sd, 1.0)
        self.apart += (1.0 - exp(-dt / SMOOTH_S)) * (turned - self.apart)
        return self._doubt.judge(t_ns, abs(self.apart), max(LEAST_LIMIT, LIMIT * sd))
