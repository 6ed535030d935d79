"""Checks of model and trials before a refinement.

A refinement moves markers to the positions with the smallest error. It would therefore hide wrong
units, exchanged labels and unscaled models. These faults are detected and reported.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.marker_refinement._motion_trial import MotionTrial, RefinementError
from jointfit_daemon.kinematics.exchanged_labels import find_exchanged_labels
from jointfit_daemon.kinematics.inverse_kinematics import IkOptions, solve_frames, tracking_error

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel

_LEAST_FRAMES = 10
"""Smallest number of frames with enough markers."""
_UNIT_FACTOR = 100.0
"""Size ratio of trial to model, or its reciprocal, above which the length unit must be wrong."""
_MOST_STRETCH = 1.3
"""Size ratio of trial to model, or its reciprocal, above which the refinement is refused."""
_NOTED_STRETCH = 1.1
"""Size ratio of trial to model, or its reciprocal, above which a note is returned."""
_APART_M = 0.04
"""Smallest distance of two markers of one segment that is used for the size ratio, m."""
MOST_RMS_M = 0.08
"""RMS marker error of a trial above which labels, scaling or axes must be wrong, m."""
_FAR_M = 0.025
"""Distance from the model position above which a marker may have the label of another marker, m."""
_SWAP_LEAST_M = 0.05
"""Limit for a group of markers, m: square root of the sum of the squared distances of the markers
from their model positions. A group below this limit does not count as exchanged.
"""
_SWAPPED_TRIAL = 0.5
"""Smallest fraction of frames with exchanged labels with which the whole trial is refused."""
_ROBUST = IkOptions(huber_m=0.02, reweightings=4)


@dataclass(frozen=True, slots=True)
class CheckedTrials:
    """Usable trials, free coordinates and notes for the user."""

    trials: tuple[MotionTrial, ...]
    free: NDArray[np.bool_]
    """Coordinates of the M markers that the refinement may move, shape (M, 3)."""
    notes: tuple[str, ...]


def check(
    model: ChainModel, trials: Sequence[MotionTrial], validation: Sequence[MotionTrial] = ()
) -> CheckedTrials:
    """Return the usable trials and the free coordinates.

    Raises
    ------
    RefinementError
        A fault prevents the refinement; the message lists the faults of all trials. Trials with
        the same name are parts of one movement. A fault of their marker names, unit or size is
        listed once.
    """
    every = [*trials, *validation]
    by_name: dict[str, list[str]] = {}
    for trial in every:
        if found := find_trial_faults(model, trial):
            by_name.setdefault(trial.name, found)
    faults = [fault for found in by_name.values() for fault in found]
    free, held = _movable(model, trials)
    if not trials:
        faults.append("no training trial given")
    elif not free.any():
        faults.append(
            "all coordinates are locked: nothing to refine"
            if model.locked.all()
            else "no marker can be refined: each is locked, has weight 0, is missing in the"
            " training trials, or is the only one on its segment"
        )

    if faults:
        raise RefinementError("; ".join(faults))
    usable, notes = [], [*held, *_gaps(model, every), *_size_notes(model, every)]
    for trial in trials:
        cleaned, remarks, wrong = _labels(model, trial)
        usable.append(cleaned)
        notes += remarks
        faults += wrong

    if faults:
        raise RefinementError("; ".join(faults))
    return CheckedTrials(tuple(usable), free, tuple(notes))


def find_trial_faults(
    model: ChainModel, trial: MotionTrial, fewest_frames: int = _LEAST_FRAMES
) -> list[str]:
    """Return the reasons why markers, unit or size of a trial do not agree with the model."""
    whole = np.isfinite(trial.targets).all(axis=-1)
    if (whole.sum(axis=1) >= 3).sum() < fewest_frames:
        few = f"fewer than {fewest_frames} frames show"
        least = "no frame shows" if fewest_frames == 1 else few
        return [f"{trial.name}: {least} three or more of the model's markers: check their names"]

    stretch = _stretch(model, trial)
    if not np.isfinite(stretch):
        return []
    if stretch > _UNIT_FACTOR or stretch < 1.0 / _UNIT_FACTOR:
        return [
            f"{trial.name}: {stretch:.3g} times as large as the model: check the length unit of"
            " the file (millimetres declared as metres?)"
        ]

    if not 1.0 / _MOST_STRETCH < stretch < _MOST_STRETCH:
        return [
            f"{trial.name}: {stretch:.2f} times as large as the model: scale the model first,"
            " otherwise the refinement would hide the wrong scale"
        ]

    return []


def _stretch(model: ChainModel, trial: MotionTrial) -> float:
    """Return the median ratio of measured to nominal distances of markers on one segment."""
    p, y, s = model.positions, trial.targets, model.marker_segments
    ratios = []
    for i, j in combinations(range(len(p)), 2):
        apart = float(np.linalg.norm(p[i] - p[j]))
        both = np.isfinite(y[:, i] - y[:, j]).all(axis=-1)
        if s[i] == s[j] and apart > _APART_M and both.any():
            measured = np.linalg.norm(y[both, i] - y[both, j], axis=-1)
            ratios.append(float(np.median(measured)) / apart)
    return float(np.median(ratios)) if ratios else float("nan")


def _size_notes(model: ChainModel, trials: Sequence[MotionTrial]) -> list[str]:
    """Return a note for each name of a trial whose size differs from the size of the model."""
    notes: dict[str, str] = {}
    for trial in trials:
        size = _stretch(model, trial)
        if np.isfinite(size) and not 1.0 / _NOTED_STRETCH < size < _NOTED_STRETCH:
            text = (
                f"{trial.name}: {size:.2f} times as large as the model: scale the model, otherwise"
                " the refinement compensates for its size"
            )
            notes.setdefault(trial.name, text)
    return list(notes.values())


def _movable(
    model: ChainModel, trials: Sequence[MotionTrial]
) -> tuple[NDArray[np.bool_], list[str]]:
    """Return the coordinates that the trials determine, and notes on markers that stay fixed."""
    seen = np.zeros(len(model.markers), dtype=np.bool_)
    for trial in trials:
        seen |= np.isfinite(trial.targets).all(axis=-1).any(axis=0)
    seen &= model.weights > 0.0

    # With only one marker on a segment, its position and the segment's pose are indistinguishable.
    counted = np.bincount(model.marker_segments[seen], minlength=len(model.segments))
    alone = seen & (counted[model.marker_segments] == 1)
    free = ~model.locked & (seen & ~alone)[:, None]

    notes = []
    absent = [m.name for m, there in zip(model.markers, seen, strict=True) if not there]
    if absent:
        notes.append(
            "position kept, because the marker is in no training trial or has weight 0:"
            f" {', '.join(absent)}"
        )
    notes += [
        f"{m.name}: the only marker on {m.segment}, so its position is not observable and is kept"
        for m, only in zip(model.markers, alone, strict=True)
        if only and not all(m.locked)
    ]
    return free, notes


def _gaps(model: ChainModel, trials: Sequence[MotionTrial]) -> list[str]:
    """Return a note for each trial that lacks markers which another trial contains."""
    present: NDArray[np.bool_] = np.array(
        [np.isfinite(t.targets).all(axis=-1).any(axis=0) for t in trials]
    )
    partly = np.any(present, axis=0) & ~np.all(present, axis=0)

    return [
        f"{trial.name}: {', '.join(missing)} missing in every frame"
        for trial, there in zip(trials, present, strict=True)
        if (
            missing := [
                m.name for m, p, t in zip(model.markers, partly, there, strict=True) if p and not t
            ]
        )
    ]


def _labels(model: ChainModel, trial: MotionTrial) -> tuple[MotionTrial, list[str], list[str]]:
    """Return the trial, notes, and faults.

    In the trial, exchanged markers are missing (NaN) in the frames of the exchange.
    """
    found = solve_frames(model, trial.targets, options=_ROBUST)
    if not (trial.targets.shape[0] and np.isfinite(found.residuals).any()):
        return (
            trial,
            [],
            [f"{trial.name}: the model fits none of its frames: check marker names, unit and axes"],
        )
    faults, notes, targets = [], [], trial.targets.copy()
    for group, frames in exchanged_markers(found.residuals, trial.targets).items():
        text = f"{trial.name}: {exchange_text(model, group)}"
        if frames.mean() >= _SWAPPED_TRIAL:
            faults.append(f"{text}: correct their labels")
        else:
            notes.append(f"{text} in {frames.sum()} frames: they are ignored in these frames")
            targets[frames[:, None] & np.isin(np.arange(targets.shape[1]), group)] = np.nan

    rms = tracking_error(found.residuals)
    if rms > MOST_RMS_M and not faults:
        faults.append(
            f"{trial.name}: the model is {1000 * rms:.0f} mm RMS off its markers: check labels,"
            " scaling and axes"
        )

    return replace(trial, targets=targets), notes, faults


def exchanged_markers(residuals: Array, targets: Array) -> dict[tuple[int, ...], NDArray[np.bool_]]:
    """Return groups of markers that fit much better after an exchange of labels.

    The value of each group is the mask of the frames with this exchange. In each group every marker
    is at the position of the next marker, and the last marker is at the position of the first.
    """
    places = targets + residuals  # positions in the model
    own = np.einsum("tmi,tmi->tm", residuals, residuals)
    far = own > _FAR_M**2  # False where a marker is missing
    found: dict[tuple[int, ...], NDArray[np.bool_]] = {}
    for frame in np.flatnonzero(far.sum(axis=1) > 1):
        for group in find_exchanged_labels(places[frame], targets[frame], far[frame]):
            if own[frame, list(group)].sum() > _SWAP_LEAST_M**2:
                frames = found.setdefault(group, np.zeros(len(targets), dtype=bool))
                frames[frame] = True
    return found


def exchange_text(model: ChainModel, group: tuple[int, ...]) -> str:
    """Return a text on exchanged markers.

    For a group of more than two, the text names the marker at whose position each marker is.
    """
    names = [model.markers[i].name for i in group]
    if len(names) == 2:
        return f"{names[0]} and {names[1]} look exchanged"
    order = ", ".join(
        f"{name} is at the place of {other}"
        for name, other in zip(names, names[1:] + names[:1], strict=True)
    )
    return f"{', '.join(names[:-1])} and {names[-1]} look exchanged ({order})"
