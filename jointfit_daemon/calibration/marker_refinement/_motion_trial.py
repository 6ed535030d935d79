"""Input of a refinement: trials with measured markers, and the settings.

Positions are in meters, in the order of the model's markers, NaN where a marker is missing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from jointfit_daemon.calibration.marker_refinement._coordinate_search import SearchSettings

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

RefinementMethod = Literal["joint", "block", "search"]


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
        """Return at most so many frames, evenly over the whole trial."""
        every = max(1, -(-len(self.targets) // most))
        return MotionTrial(self.name, self.targets[::every], self.rate_hz / every)

    def split(self, last_share: float) -> tuple[MotionTrial, MotionTrial]:
        """Return the first part and the last, each of frames that follow each other."""
        cut = len(self.targets) - round(last_share * len(self.targets))
        first = MotionTrial(self.name, self.targets[:cut], self.rate_hz)
        return first, MotionTrial(self.name, self.targets[cut:], self.rate_hz)


@dataclass(frozen=True, slots=True)
class RefinementSettings:
    """How to refine."""

    method: RefinementMethod = "joint"
    prior: float = 0.05
    """λ: cost of one metre from the nominal position relative to one metre of error."""
    huber_m: float | None = 0.02
    """Errors beyond count by their length, not its square, m; None: all squares."""
    frames: int = 150
    """Frames of every trial at most: long trials are thinned, so that none outweighs the others."""
    evenness: float = 0.0
    """Trials weigh as the power of their own error: more makes them more alike."""
    limit_m2: float = 1.0
    """Weight, m^2/rad^2, of a hinge's excess over its limits, where the model has limits."""
    holdout_share: float = 0.0
    """Last share of every training trial that only decides when to stop; 0: all is learned from."""
    tolerance: float | None = None
    """Relative decrease of F that ends it; None: the method's own."""
    search: SearchSettings = field(default_factory=SearchSettings)
