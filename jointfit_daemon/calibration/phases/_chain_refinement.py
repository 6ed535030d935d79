"""Refinement of the markers of a chain model by inverse kinematics of the movement.

Positions are refined on the first part of the movement and evaluated on the rest. A segment uses
the refined positions only if they reduce the error of its markers on the rest. If they do not
reduce the error of the whole model, all segments use the nominal positions of the model. If the
model does not fit the movement, the fault is reported, and the calibration continues without a
refinement.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._quality import (
    ChainQuality,
    MarkerErrors,
    PartQuality,
    quality_table,
)
from jointfit_daemon.calibration._robust_weights import rms
from jointfit_daemon.calibration.marker_refinement import (
    STOPPED,
    MotionTrial,
    RefinementError,
    evaluate_trial,
    refine_markers,
)
from jointfit_daemon.kinematics.accepted_errors import (
    ACCEPTED_MAXIMUM_M,
    ACCEPTED_RMS_M,
    is_accepted,
)
from jointfit_daemon.kinematics.inverse_kinematics import IkOptions
from jointfit_daemon.limb_model import RefinedChain, chain_fingerprint, vector
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._jobs import JobControl
    from jointfit_daemon.calibration._trial import (
        CalibrationSettings,
        CalibrationTrial,
        ChainRefinement,
        OpticalTrack,
    )
    from jointfit_daemon.calibration.marker_refinement import Refinement, TrialOutcome
    from jointfit_daemon.kinematics.chains import ChainModel
    from jointfit_daemon.limb_model import Calibration

FARTHEST_M = 0.06
"""Largest plausible position error of a marker in a model, m. In operation, a marker at this
distance counts as misplaced.
"""


@dataclass(frozen=True, slots=True)
class ChainOutcome:
    """Result of the refinement of a chain model."""

    chain: RefinedChain | None = None
    """Refined markers; None if the positions of the model are used."""
    figures: ChainQuality | None = None
    """Figures of the refinement; None without a chain model."""
    notes: tuple[str, ...] = ()


def refine_chain(
    functional: CalibrationTrial, settings: CalibrationSettings, control: JobControl
) -> ChainOutcome:
    """Refine the markers of the chain model of the rig, if the rig has a chain model.

    Parameters
    ----------
    functional
        The movement.
    settings
        Chain model, options and held-out fraction of the movement.
    control
        Elapsed time, which limits the iteration, and the function that reports progress.
    """
    wanted = settings.chain_refinement
    if wanted is None or not settings.refine_markers or functional.optical is None:
        return ChainOutcome()
    moving = marker_trial(wanted.model, functional.optical)
    learned, unseen = moving.split(settings.holdout_share)
    began_s = control.elapsed_s()

    def show_progress(share: float, error: float) -> None:
        text = f"refining the markers of the chain model: error {MM_PER_M * error:.1f} mm"
        control.report(share, text)

    try:
        found = refine_markers(
            wanted.model,
            [learned],
            wanted.settings,
            [unseen],
            show_progress,
            stop=lambda: control.elapsed_s() - began_s >= wanted.limit_s,
        )
    except (RefinementError, np.linalg.LinAlgError) as refusal:
        model, reason = wanted.model.name, str(refusal)
        text = f"chain model {model!r}: markers not refined: {reason}"
        return ChainOutcome(None, ChainQuality(model, wanted.settings.method, reason), (text,))
    return _outcome(wanted, found, unseen.thin(wanted.settings.frames))


def with_refined_chain(
    calibration: Calibration,
    functional: CalibrationTrial,
    settings: CalibrationSettings,
    control: JobControl,
) -> Calibration:
    """Return the calibration with the refined chain model; unchanged without a chain model."""
    outcome = refine_chain(functional, settings, control)
    if outcome.figures is None:
        return calibration
    quality = {**calibration.quality, "chain": quality_table(outcome.figures)}
    notes = (*calibration.notes, *outcome.notes)
    return replace(calibration, chain=outcome.chain, quality=quality, notes=notes)


def marker_trial(model: ChainModel, optical: OpticalTrack) -> MotionTrial:
    """Return the positions of the model's markers in a movement; NaN where a marker is missing."""
    targets = np.full((len(optical.t_ns), len(model.markers), 3), np.nan)
    for at, name in enumerate(model.marker_names):
        if name in optical.markers:
            targets[:, at] = optical.positions[:, optical.markers.index(name)]
    rate_hz = 1e9 / float(np.median(np.diff(optical.t_ns)))
    return MotionTrial("functional", targets, rate_hz)


def _outcome(wanted: ChainRefinement, found: Refinement, unseen: MotionTrial) -> ChainOutcome:
    """Select the segments whose markers have a smaller error on the held-out frames."""
    model = wanted.model
    shift = found.model.positions - model.positions
    far = np.linalg.norm(shift, axis=1) >= FARTHEST_M
    refused = {model.markers[m].segment for m in np.flatnonzero(far)}
    notes = [
        f"chain model {model.name!r}: markers of {model.markers[m].segment} not refined: "
        f"{model.markers[m].name} would move by {MM_PER_M * np.linalg.norm(shift[m]):.0f} mm; "
        "check its label, and its place in the model"
        for m in np.flatnonzero(far)
    ]

    holdout, parts = _select(wanted, found, unseen, refused)
    figures = _figures(wanted, found, holdout, parts, shift)
    notes += _notes(wanted, found, figures)
    used = {s for s, part in parts.items() if part.refined}
    positions = {m.name: vector(m.position) for m in found.model.markers if m.segment in used}
    record = RefinedChain(model.name, chain_fingerprint(model), positions) if used else None
    return ChainOutcome(record, figures, tuple(notes))


def _select(
    wanted: ChainRefinement, found: Refinement, unseen: MotionTrial, refused: set[str]
) -> tuple[TrialOutcome, dict[str, PartQuality]]:
    """Return the errors of the held-out trial, and the errors of each segment with moved markers.

    The refined positions are used only on the selected segments. A segment is selected if it is not
    in `refused` and the refined positions reduce the error of its markers. The errors of a segment
    depend on its neighbors, so each selection of segments is evaluated as a whole.
    """
    model = wanted.model
    shift = found.model.positions - model.positions
    moved = {model.markers[m].segment for m in np.flatnonzero(shift.any(axis=1))}
    holdout = next(trial for trial in found.trials if not trial.trained)
    errors = _part_errors(model, holdout, moved)
    parts = {s: PartQuality(*both, refined=False) for s, both in errors.items()}

    used = moved - refused
    while True:
        if used != moved:
            selected = np.array([m.segment in used for m in model.markers])
            mixed = model.with_markers(model.positions + shift * selected[:, None])
            within = IkOptions(limit_m2=wanted.settings.limit_m2)
            holdout = evaluate_trial(model, mixed, unseen, trained=False, options=within)
        errors = _part_errors(model, holdout, used)
        parts |= {s: PartQuality(*both, refined=True) for s, both in errors.items()}
        worse = {s for s, (before, after) in errors.items() if after >= before}
        if not worse and holdout.after.rms >= holdout.before.rms:
            worse = used
        if not worse:
            return holdout, parts
        parts |= {s: replace(parts[s], refined=False) for s in worse}
        used = used - worse


def _part_errors(
    model: ChainModel, holdout: TrialOutcome, segments: set[str]
) -> dict[str, tuple[float, float]]:
    """Return the RMS errors of the markers of each segment before and after refinement, m."""
    names = np.array([m.segment for m in model.markers])
    before, after = holdout.before.by_marker, holdout.after.by_marker
    return {s: (rms(before[names == s], 0.0), rms(after[names == s], 0.0)) for s in segments}


def _figures(
    wanted: ChainRefinement,
    found: Refinement,
    holdout: TrialOutcome,
    parts: dict[str, PartQuality],
    shift: Array,
) -> ChainQuality:
    model = wanted.model
    stopped = found.stopped
    if stopped == STOPPED:
        stopped = f"stopped after {wanted.limit_s:g} s"
    used = {s for s, part in parts.items() if part.refined}
    return ChainQuality(
        model.name,
        found.method,
        frames=next(trial.frames for trial in found.trials if trial.trained),
        judged=holdout.frames,
        before=_errors(holdout.before.rms, holdout.before.maximum),
        after=_errors(holdout.after.rms, holdout.after.maximum),
        parts={s: parts[s] for s in model.segment_names if s in parts},
        moved_m={
            m.name: float(np.linalg.norm(shift[k]))
            for k, m in enumerate(model.markers)
            if m.segment in used
        },
        stopped=stopped,
    )


def _errors(root_mean_square: float, maximum: float) -> MarkerErrors:
    return MarkerErrors(root_mean_square, maximum, is_accepted(root_mean_square, maximum))


def _notes(wanted: ChainRefinement, found: Refinement, figures: ChainQuality) -> list[str]:
    """Return notes for the operator on faults and possible improvements."""
    name = f"chain model {wanted.model.name!r}"
    notes = [f"{name}: {note}" for note in found.notes]
    if found.stopped == STOPPED:
        notes.append(
            f"{name}: the refinement was {figures.stopped}, before it converged; the result so far "
            "was evaluated. Use fewer frames, another method, or a longer limit_s"
        )
    if found.gauge.fixed_by == "nothing":
        prior = "use method joint or block" if found.method == "search" else "set prior"
        notes.append(
            f"{name}: {found.gauge.free} motions of {', '.join(found.gauge.involved)} are not "
            f"determined by the movement: lock markers on bony landmarks, or {prior}"
        )
    if (after := figures.after) is not None and not after.accepted:
        notes.append(
            f"{name}: marker errors of {MM_PER_M * after.rms_m:.0f} mm RMS, "
            f"{MM_PER_M * after.maximum_m:.0f} mm at most, expected below "
            f"{MM_PER_M * ACCEPTED_RMS_M:.0f} and {MM_PER_M * ACCEPTED_MAXIMUM_M:.0f} mm: check "
            "labels, scale and joints of the model"
        )
    return notes
