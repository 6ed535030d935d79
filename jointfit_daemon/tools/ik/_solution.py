"""Inverse kinematics of one trial: input checks, solution, and coordinates with their uncertainty.

A coordinate is NaN if its frame has no solution, or if the visible markers do not determine the
coordinate.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np

from jointfit_daemon.calibration.marker_refinement import (
    MOST_RMS_M,
    MotionTrial,
    RefinementError,
    exchange_text,
    exchanged_markers,
    find_trial_faults,
    require_marker,
)
from jointfit_daemon.files.mocap import read_marker_trial
from jointfit_daemon.files.models import IkSetup, load_model, read_ik_setup
from jointfit_daemon.kinematics.chain_coordinates import coordinate_table
from jointfit_daemon.kinematics.inverse_kinematics import (
    IkOptions,
    pose_covariance,
    restart_local_minima,
    solve_frames,
)
from jointfit_daemon.name_lists import list_names
from jointfit_daemon.nearest_name import did_you_mean
from jointfit_daemon.tools.marker_model import motion_trial

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.files.mocap import MarkerTrial
    from jointfit_daemon.files.models import LoadedModel
    from jointfit_daemon.kinematics.chains import ChainModel
    from jointfit_daemon.kinematics.inverse_kinematics import IkResult

_LIMIT_M2 = 1.0
"""Weight of angles beyond the joint limits, m^2/rad^2; `jointfit markers` uses the same weight."""
_MOST_HINTS = 5
"""Maximum number of missing markers in a note that proposes similar names."""
_FEWEST_MARKERS = 3
"""Minimum number of visible markers in a frame with a solution. Fewer markers do not determine the
pose of the first segment."""
_MISFIT_RAD = 0.0017
"""Rotation that the coordinates of the model cannot represent, above which a note is given, rad
(0.1 degrees)."""


@dataclass(frozen=True, slots=True)
class IkRequest:
    """Command-line options of `jointfit ik`."""

    trial: Path
    model: Path
    weights: tuple[str, ...] = ()
    setup: Path | None = None
    without: tuple[str, ...] = ()
    span: tuple[float | None, float | None] = (None, None)
    use_limits: bool = True
    up: str | None = None


@dataclass(frozen=True, slots=True)
class TrialSolution:
    """Coordinates and marker errors at T times, with K coordinates and M tracked markers."""

    trial: str
    model: ChainModel
    t_s: Array
    rate_hz: float
    names: tuple[str, ...]
    is_angle: tuple[bool, ...]
    values: Array
    """Value of each coordinate, rad and m, shape (T, K); NaN where unknown."""
    sd: Array
    """Standard deviation of each coordinate, rad and m, shape (T, K); NaN where unknown."""
    marker_names: tuple[str, ...]
    distances: Array
    """Distance of each marker from its model position, m, shape (T, M); NaN where missing."""
    solved: NDArray[np.bool_]
    """Whether the frame has a solution, shape (T,)."""
    restarted: int
    """Number of frames whose error decreased after a restart from another pose."""
    notes: tuple[str, ...]

    @property
    def complete(self) -> NDArray[np.bool_]:
        """Whether all coordinates of the frame are known, shape (T,)."""
        return np.asarray(np.isfinite(self.values).all(axis=1))


def solve_trial(asked: IkRequest) -> TrialSolution:
    """Return the solution of a trial.

    Raises
    ------
    RefinementError
        The trial does not fit the model because of other markers, another unit, size or labels.
    ValueError
        A name in an option is unknown, or the time range is empty. A damaged file raises
        `MalformedFileError`.
    """
    loaded = load_model(asked.model)
    setup = IkSetup({}, None, ()) if asked.setup is None else read_ik_setup(asked.setup)
    trial = read_marker_trial(asked.trial, cast("Axis | None", asked.up))
    model = loaded.chain
    weights, notes = _weights(asked, setup, model)
    notes = [*loaded.remarks, *trial.trajectories.warnings, *notes]

    # Select the frames in the time range; options take precedence over the set-up file.
    t_s = trial.trajectories.t_s
    given = setup.time_range or (-np.inf, np.inf)
    low, high = (g if a is None else a for g, a in zip(given, asked.span, strict=True))
    half = 0.5 / trial.trajectories.rate_hz
    inside = (t_s >= low - 1e-3 * half) & (t_s <= high + 1e-3 * half)
    if not inside.any():
        raise ValueError(
            f"{asked.trial}: no frame between {low:g} and {high:g} s: the trial lasts from"
            f" {t_s.min():g} to {t_s.max():g} s: change --start, --end or the set-up file"
        )
    part = np.asarray(inside)

    targets = motion_trial(asked.trial.stem, trial, model).targets[part]
    targets[:, weights == 0.0] = np.nan
    motion = MotionTrial(asked.trial.stem, targets, trial.trajectories.rate_hz)
    notes += _check(asked, model, motion, trial, weights)

    options = IkOptions(limit_m2=_LIMIT_M2 if asked.use_limits else 0.0)
    found = solve_frames(model, targets, weights, options=options)
    found, improved = restart_local_minima(model, targets, weights, found, options)

    # Note exchanged labels; raise `RefinementError` if the trial does not fit the model.
    remarks = []
    for group, frames in exchanged_markers(found.residuals, motion.targets).items():
        text = exchange_text(model, group)
        remarks.append(f"{text} in {int(frames.sum())} frames: correct their labels")

    square = np.einsum("tmi,tmi->tm", found.residuals, found.residuals)
    rms = float(np.sqrt(np.nanmean(square)))
    if rms > MOST_RMS_M:
        raise RefinementError(
            f"{motion.name}: the markers are {1000 * rms:.0f} mm RMS from the model, expected less"
            f" than {1000 * MOST_RMS_M:.0f} mm: check labels, scaling and axes (--up)"
            + "".join(f"; {note}" for note in remarks)
        )
    notes += remarks
    return _trial_solution(loaded, motion, trial.trajectories.t_s[part], (found, improved, notes))


def _weights(asked: IkRequest, setup: IkSetup, model: ChainModel) -> tuple[Array, list[str]]:
    """Return the weight of each marker of the model, and notes."""
    weights, notes = model.weights.copy(), []
    index = {name: k for k, name in enumerate(model.marker_names)}
    if setup.weights:
        # As in OpenSim, markers without a task are not tracked.
        weights = np.array([setup.weights.get(name, 0.0) for name in index])
        unknown = [name for name in setup.weights if name not in index]
        if unknown:
            notes.append(f"{asked.setup}: tasks of unknown markers ignored: {list_names(unknown)}")
        if setup.ignored:
            notes.append(f"{asked.setup}: coordinate tasks ignored: {list_names(setup.ignored)}")

    for text in asked.weights:
        name, _, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = -1.0
        if not name or not 0.0 <= value < float("inf"):
            raise ValueError(
                f"--weight {text}: expected NAME=NUMBER with a number of at least 0, such as"
                f" {model.marker_names[0] if index else 'NAME'}=2"
            )
        require_marker(model, name, "--weight")
        weights[index[name]] = value
    for name in asked.without:
        require_marker(model, name, "--without")
        weights[index[name]] = 0.0
    return weights, notes


def _check(
    asked: IkRequest, model: ChainModel, motion: MotionTrial, trial: MarkerTrial, weights: Array
) -> list[str]:
    """Return notes on missing markers; raise `RefinementError` for a trial of another model."""
    seen: NDArray[np.bool_] = np.asarray(np.isfinite(motion.targets).all(axis=-1).any(axis=0))
    if not seen.any():
        raise RefinementError(
            f"{asked.trial} has none of the {int((weights > 0).sum())} tracked markers of"
            f" {asked.model}: found {list_names(trial.trajectories.names)}, expected"
            f" {list_names(model.marker_names)}: rename the markers, or use the model of this"
            " marker set"
        )
    faults = find_trial_faults(model, motion, fewest_frames=1)
    if faults:
        raise RefinementError("; ".join(faults))
    absent = [m.name for m, s, w in zip(model.markers, seen, weights, strict=True) if not s and w]
    spare = set(trial.trajectories.names) - set(model.marker_names)
    hints = {name: did_you_mean(name, sorted(spare)) for name in absent[:_MOST_HINTS]}
    shown = [f"{name}: {hint}" for name, hint in hints.items() if hint]
    listed = "; ".join((f"not in the trial: {list_names(absent)}", *shown))
    return [listed] if absent else []


def _trial_solution(
    loaded: LoadedModel,
    motion: MotionTrial,
    t_s: Array,
    result: tuple[IkResult, NDArray[np.bool_], list[str]],
) -> TrialSolution:
    found, improved, notes = result
    model = loaded.chain
    seen = np.isfinite(found.residuals).all(axis=-1)
    solved = found.converged & (seen.sum(axis=1) >= _FEWEST_MARKERS)
    covariance, determined = pose_covariance(model, found)

    # Whether the markers determine all degrees of freedom of the coordinate's joint, shape (T, K).
    whole = [
        determined[:, columns].all(axis=1)
        for columns, joint in zip(loaded.chain.columns, loaded.coordinates, strict=True)
        for _ in joint.names
    ]
    known = np.stack(whole, axis=1) & solved[:, None]
    table = coordinate_table(model, found.state, covariance, loaded.coordinates, known)
    notes += [
        f"{segment}: its coordinates cannot represent up to {np.degrees(most):.1f}° of its rotation"
        for segment, most in table.misfit.items()
        if most > _MISFIT_RAD
    ]

    ever = known.any(axis=0)
    if not ever.any():
        raise RefinementError(
            f"{motion.name}: the markers determine no coordinate in any frame: track more markers"
            f" of {model.name}"
        )
    never = [name for name, some in zip(table.names, ever, strict=True) if not some]
    if never:
        notes.append(f"coordinates omitted, because no markers determine them: {list_names(never)}")

    tracked = seen.any(axis=0)
    return TrialSolution(
        motion.name,
        model,
        t_s,
        motion.rate_hz,
        tuple(np.array(table.names)[ever].tolist()),
        tuple(np.array(table.is_angle)[ever].tolist()),
        np.where(known, table.values, np.nan)[:, ever],
        np.where(known, table.sd, np.nan)[:, ever],
        tuple(np.array(model.marker_names)[tracked].tolist()),
        np.linalg.norm(found.residuals[:, tracked], axis=-1),
        solved,
        int(improved.sum()),
        tuple(notes),
    )
