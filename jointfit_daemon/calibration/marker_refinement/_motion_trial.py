"""Input of a refinement, which consists of trials with measured markers and settings.

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
    """Measured positions of M markers in T frames, world, m, shape (T, M, 3); NaN where missing."""
    rate_hz: float

    def thin(self, most: int) -> MotionTrial:
        """Return at most `most` frames, evenly spaced over the whole trial."""
        every = max(1, -(-len(self.targets) // most))
        return MotionTrial(self.name, self.targets[::every], self.rate_hz / every)

    def split(self, last_share: float) -> tuple[MotionTrial, MotionTrial]:
        """Return the first part and the last part; the last has the fraction `last_share`."""
        cut = len(self.targets) - round(last_share * len(self.targets))
        first = MotionTrial(self.name, self.targets[:cut], self.rate_hz)
        return first, MotionTrial(self.name, self.targets[cut:], self.rate_hz)


@dataclass(frozen=True, slots=True)
class RefinementSettings:
    """Settings of a refinement."""

    method: RefinementMethod = "joint"
    prior: float = 0.05
    """Weight λ of the prior: cost of a displacement of 1 m from the nominal position, relative to
    the cost of an error of 1 m in every frame.
    """
    huber_m: float | None = 0.02
    """Error above which the loss is linear instead of quadratic, m. With None the loss is quadratic
    for all errors.
    """
    cost: RefinementCost = "l2"
    """Loss function. ``l2`` is the squared error up to `huber_m`. ``l1`` is the distance, so that a
    marker with frequent large errors has little influence. The method ``search`` does not support
    ``l1``.
    """
    frames: int = 150
    """Largest number of frames of a trial. Longer trials are decimated, so that no trial dominates.
    """
    evenness: float = 0.0
    """Exponent p. The weight of a trial with the error e is proportional to e to the power p. A
    larger exponent makes the errors of trials more equal.
    """
    limit_m2: float = 1.0
    """Weight of the squared excess of hinge angles over their limits, m^2/rad^2. It has no effect
    on a model without limits.
    """
    holdout_share: float = 0.0
    """Fraction of every training trial, at its end, that is not fitted. The error of these frames
    determines when the iteration stops.
    """
    tolerance: float | None = None
    """Relative decrease of F below which the iteration ends; None selects the default of the
    method.
    """
    search: SearchSettings = field(default_factory=SearchSettings)
