"""Input of a refinement: trials with measured markers, and the settings.

Positions are in meters, in the order of the model's markers, NaN where a marker is missing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from jointfit_daemon.calibration.marker_refinement._coordinate_search import SearchSettings

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._refinement_choices import RefinementCost, RefinementMethod


class RefinementError(ValueError):
    """Model and trials do not allow a refinement; the message lists all reasons."""


@dataclass(frozen=True, slots=True)
class MotionTrial:
    """One movement."""

    name: str
    targets: Array
    """Measured markers, world, m, shape (T, M, 3); NaN where missing."""
    rate_hz: float

    def thinned(self, most: int) -> MotionTrial:
        """Return at most `most` frames, evenly over the whole trial."""
        every = max(1, -(-len(self.targets) // most))
        return MotionTrial(self.name, self.targets[::every], self.rate_hz / every)

    def split(self, last_share: float) -> tuple[MotionTrial, MotionTrial]:
        """Return the first and the last part, each with consecutive frames."""
        cut = len(self.targets) - round(last_share * len(self.targets))
        first = MotionTrial(self.name, self.targets[:cut], self.rate_hz)
        return first, MotionTrial(self.name, self.targets[cut:], self.rate_hz)


@dataclass(frozen=True, slots=True)
class RefinementSettings:
    """Settings of a refinement."""

    method: RefinementMethod = "joint"
    prior: float = 0.05
    """λ: cost of a displacement of 1 m from the nominal position relative to an error of 1 m."""
    huber_m: float | None = 0.02
    """Error above which the loss is linear instead of quadratic, m; None: quadratic for all
    errors."""
    cost: RefinementCost = "l2"
    """``l2``: squared errors up to `huber_m`. ``l1``: distances, so that a marker that is often far
    off has little influence. Not with the method ``search``."""
    frames: int = 150
    """Largest number of frames of a trial; longer trials are decimated, so that none dominates."""
    evenness: float = 0.0
    """Exponent of a trial's error in its weight; a larger one makes the errors of trials more
    equal."""
    limit_m2: float = 1.0
    """Weight, m^2/rad^2, of a hinge's excess over its limits, where the model has limits."""
    holdout_share: float = 0.0
    """Share of every training trial, at its end, that is not fitted but decides when to stop."""
    tolerance: float | None = None
    """Relative decrease of F that ends the iteration; None: the default of the method."""
    search: SearchSettings = field(default_factory=SearchSettings)
