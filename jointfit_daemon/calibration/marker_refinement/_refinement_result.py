"""Result of a refinement: marker displacements, tracking errors and changes of joint angles.

All values are in SI units. Errors are computed with unit weights, independent of the weights of the
fit. Variances over frames and over trials are divided by N, not N - 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._refinement_choices import RefinementMethod
    from jointfit_daemon.calibration.marker_refinement._gauge import Gauge
    from jointfit_daemon.kinematics.chains import ChainModel


@dataclass(frozen=True, slots=True)
class TrackingStatistics:
    """Tracking error of one model on one trial."""

    rms: float
    """RMS over all markers and frames, m."""
    maximum: float
    """Largest error of one marker in one frame, m."""
    variance: float
    """Variance over time of the RMS over the markers of each frame, m²."""
    by_marker: Array
    """RMS error of each of the M markers, m, shape (M,); NaN if a marker is never visible."""


@dataclass(frozen=True, slots=True)
class TrialOutcome:
    """Errors of one trial before and after the refinement."""

    name: str
    trained: bool
    """Whether the trial was used in the refinement."""
    frames: int
    rate_hz: float
    before: TrackingStatistics
    after: TrackingStatistics
    angles: dict[str, tuple[float, float]]
    """RMS and greatest change of each joint rotation by segment, rad; the root segment is excluded.
    """


@dataclass(frozen=True, slots=True)
class MarkerOutcome:
    """Result of the refinement for one marker."""

    name: str
    segment: str
    moved: tuple[float, float, float]
    """Displacement by the refinement in segment axes, m."""
    held: tuple[bool, bool, bool]
    """Whether each coordinate was locked, or is not determined by the trials."""
    rms_before: float
    """RMS error over all trials before the refinement, m; NaN if the marker is never visible."""
    rms_after: float

    @property
    def distance(self) -> float:
        """Displacement of the marker, m."""
        return float(np.linalg.norm(self.moved))


@dataclass(frozen=True, slots=True)
class Refinement:
    """Refined model with marker, trial and gauge results."""

    model: ChainModel
    method: RefinementMethod
    prior: float
    markers: tuple[MarkerOutcome, ...]
    trials: tuple[TrialOutcome, ...]
    costs: tuple[float, ...]
    """Cost F at the start and after every step, or with the method `search` the RMS error, m. The
    values never increase."""
    runs: int
    """Number of runs of inverse kinematics over all frames, for the methods `search` and `block`.
    """
    stopped: str
    gauge: Gauge
    notes: tuple[str, ...] = ()
    """Findings about the input that do not prevent the refinement."""

    def variance_of_trials(self, *, trained: bool) -> tuple[float, float]:
        """Return the variance of the RMS errors of the trials, m²: before and after the refinement.

        Both values are NaN for fewer than two trials.
        """
        some = [t for t in self.trials if t.trained == trained]
        return _variance([t.before.rms for t in some]), _variance([t.after.rms for t in some])

    def angle_change(self) -> tuple[float, float]:
        """Return RMS and greatest change of any joint rotation in any trial, rad."""
        pairs = [pair for t in self.trials for pair in t.angles.values()]
        if not pairs:
            return float("nan"), float("nan")
        rms, most = np.array(pairs).T
        return float(np.sqrt(np.mean(rms**2))), float(most.max())


def _variance(values: Sequence[float]) -> float:
    return float(np.var(values)) if len(values) > 1 else float("nan")
