"""Tracking error of a model on a trial, and the change of joint angles by a refinement.

Errors are computed with unit weights, so that different fits can be compared.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.marker_refinement._refinement_result import (
    MarkerOutcome,
    TrackingStatistics,
    TrialOutcome,
)
from jointfit_daemon.kinematics.chains import step_between
from jointfit_daemon.kinematics.inverse_kinematics import (
    restart_local_minima,
    solve_frames,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration.marker_refinement._motion_trial import MotionTrial
    from jointfit_daemon.kinematics.chains import ChainModel
    from jointfit_daemon.kinematics.inverse_kinematics import IkOptions, IkResult


def tracking_statistics(residuals: Array) -> TrackingStatistics:
    """Return the statistics of the residuals of T frames and M markers.

    `residuals` are in m, with shape (T, M, 3), and NaN where a marker is missing.
    """
    square = np.einsum("tmi,tmi->tm", residuals, residuals)
    seen = np.isfinite(square)
    square = np.where(seen, square, 0.0)
    frame = np.sqrt(_mean(square, seen, axis=1))
    return TrackingStatistics(
        float(np.sqrt(square.sum() / max(seen.sum(), 1))),
        float(np.sqrt(square.max(initial=0.0))),
        float(np.var(frame[seen.any(axis=1)])) if seen.any() else float("nan"),
        np.sqrt(_mean(square, seen, axis=0)),
    )


def _mean(square: Array, seen: NDArray[np.bool_], axis: int) -> Array:
    counted = seen.sum(axis=axis)
    total = square.sum(axis=axis)
    return np.where(counted > 0, total / np.maximum(counted, 1), np.nan)


def evaluate_trial(
    before: ChainModel,
    after: ChainModel,
    trial: MotionTrial,
    *,
    trained: bool,
    options: IkOptions | None = None,
) -> TrialOutcome:
    """Return tracking errors and joint-angle changes of one trial, solved with both models.

    Frames in a local minimum of inverse kinematics are solved again from other initial poses.
    """
    ones = np.ones(len(before.markers))
    old = solve_frames(before, trial.targets, ones, options=options)
    old, _ = restart_local_minima(before, trial.targets, ones, old, options)
    new = solve_frames(after, trial.targets, ones, start=old.state, options=options)

    return TrialOutcome(
        trial.name,
        trained,
        len(trial.targets),
        trial.rate_hz,
        tracking_statistics(old.residuals),
        tracking_statistics(new.residuals),
        rotation_changes(before, old, new),
    )


def rotation_changes(
    model: ChainModel, old: IkResult, new: IkResult
) -> dict[str, tuple[float, float]]:
    """Return RMS and greatest rotation of every joint between two solutions, rad, by segment."""
    well = ~(old.underdetermined | new.underdetermined)
    if not well.any():
        return {}
    step = step_between(model, old.state.take(well), new.state.take(well))
    found = {}
    for segment, columns in zip(model.segments, model.columns, strict=True):
        if segment.joint.kind != "free":
            angle = np.linalg.norm(step[:, columns], axis=-1)
            found[segment.name] = float(np.sqrt(np.mean(angle**2))), float(angle.max())

    return found


def marker_outcomes(
    before: ChainModel,
    after: ChainModel,
    free: NDArray[np.bool_],
    trials: Sequence[TrialOutcome],
) -> tuple[MarkerOutcome, ...]:
    """Return the displacement and the errors of every marker, pooled over all trials."""
    old = _pool_errors([t.before for t in trials], [t.frames for t in trials])
    new = _pool_errors([t.after for t in trials], [t.frames for t in trials])
    moved = after.positions - before.positions
    return tuple(
        MarkerOutcome(m.name, m.segment, tuple(d), tuple(~f), float(a), float(b))
        for m, d, f, a, b in zip(before.markers, moved.tolist(), free, old, new, strict=True)
    )


def _pool_errors(fits: Sequence[TrackingStatistics], frames: Sequence[int]) -> Array:
    square = np.array([fit.by_marker**2 for fit in fits])
    seen = np.isfinite(square)
    weight = seen * np.array(frames)[:, None]
    total = (np.where(seen, square, 0.0) * weight).sum(axis=0)
    counted = weight.sum(axis=0)
    return np.sqrt(np.where(counted > 0, total / np.maximum(counted, 1), np.nan))
