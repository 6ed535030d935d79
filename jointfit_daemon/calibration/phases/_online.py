"""Online learning: refits of the segment models to new frames with camera data.

Online learning changes only the models, not sensor-to-segment alignments, joint centers or lags. A
candidate is fitted to the training frames of the calibration and the older part of the new frames.
The candidate is compared with the current models on the newest frames, which are held out. The
current models are retained, with a reason, in three cases: the candidate is not better on the
newest frames, it is much worse on the earlier training frames, or its predictions differ too much
from those of the current models. If cameras and sensors are inconsistent, the refit raises an
error.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration._jobs import FitResult
from jointfit_daemon.calibration._quality import OnlineQuality, quality_table
from jointfit_daemon.calibration._robust_weights import rms
from jointfit_daemon.calibration.soft_tissue import (
    LimbTraining,
    fit_all_sensors,
    fit_models,
    flexion_error,
    join_training,
    joint_error_correlations,
    pack,
    predict_all_sensors,
    thin_evenly,
    unpack,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import (
    angle_convention,
    inner_joints,
    model_key,
    neighbor,
    restore_cluster,
    rigid_fit,
)

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._trial import OnlineFrames
    from jointfit_daemon.limb_model import Calibration, SegmentModel
    from jointfit_daemon.model import Chain

    Models = dict[str, SegmentModel]

FEWEST = 200
"""Smallest number of new frames."""
HELD = 0.3
"""Fraction of the new frames that is held out. These are the newest frames."""
GAIN = 0.97
"""Largest ratio of the candidate's error to the error of the current models, on held-out frames.
"""
GAIN_RAD = np.deg2rad(0.05)
"""Smallest decrease of the error with which the candidate is accepted, rad."""
WORSE = 1.15
"""Largest accepted ratio of an error on earlier frames to the same error before the refit. The
constant `WORSE_RAD` is added, as in `compare_calibrations`.
"""
WORSE_RAD = np.deg2rad(0.3)
"""Increase of an error on earlier frames that is accepted in addition to `WORSE`, rad."""
MOST_CHANGE = np.deg2rad(8.0)
"""Largest 0.95 quantile of the change of the predictions for the earlier training frames, rad. Soft
tissue does not cause a larger change.
"""
MARKERS_RMS_M = 0.015
"""RMS residual of the markers of a frame above which the frame is ignored, m."""
MOST_LEFT_OUT = 0.3
"""Largest fraction of ignored frames."""
CONTRADICTED = np.deg2rad(8.0)
"""Median angle between the orientations from the cameras and from the current models, rad. Above
this angle one of the two is wrong.
"""
SHIFTED = np.deg2rad(5.0)
"""Largest length of the median rotation vector from the orientations of the current models to the
orientations from the cameras, rad. A displaced marker cluster causes a larger rotation.
"""
TURN_FRAMES = 150
"""Number of frames over which heading drift is assumed to be constant: 15 s at 10 Hz."""


def refit_models(
    calibration: Calibration, frames: OnlineFrames, chain: Chain, *, software: str = ""
) -> FitResult:
    """Refit the models to new frames.

    Parameters
    ----------
    calibration : Calibration
        Current calibration; its ``memory`` contains the training frames.
    frames : OnlineFrames
        New frames.
    chain : Chain
        The limb.
    software : str
        Version of the program, which is stored in the quality figures.

    Returns
    -------
    FitResult
        Result whose ``quality["online"]`` contains the errors before and after the refit, rad. If
        the candidate is accepted, ``calibration`` is set. Otherwise ``kept`` contains the reason to
        retain the current models.

    Raises
    ------
    CalibrationError
        There are too few frames, the calibration has no training frames, or cameras and sensors are
        inconsistent.
    """
    known = unpack(chain, calibration.memory)
    if known is None:
        raise CalibrationError(
            "the calibration has no training frames: repeat the functional phase"
        )

    new = _without_heading_drift(calibration, _reference(calibration, frames, chain), chain)
    cut = round(len(new) * (1.0 - HELD))
    older, newest = new.rows(slice(None, cut)), new.rows(slice(cut, None))

    # The candidate is fitted without the newest frames. It is evaluated on the newest frames and
    # on the training frames of the calibration.
    training = join_training(known, thin_evenly(chain, older))
    in_force = _in_force(calibration, chain)
    candidate = {
        name: fit_all_sensors(chain, i, calibration.method, training)
        for i, name in enumerate(chain.segments)
    }
    figures = OnlineQuality(
        len(new),
        len(newest),
        before_rad=_figures(chain, in_force, newest),
        after_rad=_figures(chain, candidate, newest),
        known_before_rad=_figures(chain, in_force, known),
        known_after_rad=_figures(chain, candidate, known),
    )

    kept = _rejection(figures) or _large_change(chain, in_force, candidate, known)
    if kept is not None:
        return FitResult({"online": quality_table(figures)}, kept=kept)

    # The candidate is accepted. The final models are fitted to all frames, for all sets of sensors.
    whole = thin_evenly(chain, join_training(known, new))
    models = fit_models(chain, whole, calibration.method)
    rounds = int(calibration.quality.get("online", {}).get("rounds", 0)) + 1
    figures = replace(figures, rounds=rounds, software=software, taught=calibration.digest)

    segments = {
        name: replace(item, models=models[name]) for name, item in calibration.segment.items()
    }
    found = replace(
        calibration,
        segment=segments,
        correlations=joint_error_correlations(chain, whole, calibration.method),
        memory=pack(chain, whole),
        quality={**calibration.quality, "online": quality_table(figures)},
    )
    return FitResult(found.quality, calibration=found)


# --- optical reference ------------------------------------------------------------------------


def _reference(calibration: Calibration, frames: OnlineFrames, chain: Chain) -> LimbTraining:
    """Return the frames with consistent markers and the reference of each segment."""
    reference = {}
    for name in chain.segments:
        cluster = restore_cluster(name, calibration.clusters[name])
        if cluster.body is not None:
            turn = rotation.multiply(frames.bodies[name], rotation.conjugate(cluster.q_body))
        else:
            turn, _, rms_m = rigid_fit(cluster.template, frames.markers[name])
            turn[~(rms_m <= MARKERS_RMS_M)] = np.nan

        good = float(np.isfinite(turn[:, 0]).mean()) if len(turn) else 0.0
        if good < 1.0 - MOST_LEFT_OUT:
            raise CalibrationError(
                f"{name}: in {100 * (1 - good):.0f} % of the frames its markers do not fit the "
                "static pose; check the marker names, and whether a marker was displaced"
            )
        q_static = np.array(calibration.segment[name].q_static)
        reference[name] = rotation.multiply(turn, q_static)

    whole = np.all([np.isfinite(q).all(axis=1) for q in reference.values()], axis=0)
    if np.count_nonzero(whole) < FEWEST:
        raise CalibrationError(f"{np.count_nonzero(whole)} complete frames, {FEWEST} are needed")
    return LimbTraining(dict(frames.sensors), reference).rows(whole)


def _without_heading_drift(
    calibration: Calibration, new: LimbTraining, chain: Chain
) -> LimbTraining:
    """Return the frames without heading drift; raise an error if cameras and models disagree.

    Sensor headings drift over minutes, independent of posture. The median rotation about the
    vertical between cameras and models over 15 s is therefore removed from the reference.
    """
    estimates = _predictions(chain, _in_force(calibration, chain), new)
    reference = {}
    for name in chain.segments:
        q = new.reference[name].copy()
        off = rotation.log(rotation.multiply(q, rotation.conjugate(estimates[name])))
        for rows in np.array_split(np.arange(len(q)), max(len(q) // TURN_FRAMES, 1)):
            turn = rotation.heading(np.array(-float(np.median(off[rows, 2]))))
            q[rows] = rotation.multiply(turn, q[rows])

        off = rotation.log(rotation.multiply(rotation.conjugate(estimates[name]), q))
        apart = float(np.median(np.linalg.norm(off, axis=1)))
        shift = float(np.linalg.norm(np.median(off, axis=0)))
        if apart > CONTRADICTED or shift > SHIFTED:
            raise CalibrationError(
                f"{name}: cameras and sensors disagree by {np.rad2deg(apart):.1f} deg in the "
                f"median (limit {np.rad2deg(CONTRADICTED):g}), of which {np.rad2deg(shift):.1f} "
                f"deg are constant (limit {np.rad2deg(SHIFTED):g}); check marker names, or repeat "
                "the static pose"
            )
        reference[name] = q
    return LimbTraining(new.sensors, reference)


# --- models and their evaluation --------------------------------------------------------------


def _in_force(calibration: Calibration, chain: Chain) -> Models:
    found = {}
    for i, name in enumerate(chain.segments):
        near = "+".join(neighbor(chain, i)) or None
        found[name] = calibration.segment[name].models[model_key(chain.sensors[i], near)]
    return found


def _predictions(chain: Chain, models: Models, frames: LimbTraining) -> dict[str, Array]:
    return {
        name: predict_all_sensors(chain, i, models[name], frames)
        for i, name in enumerate(chain.segments)
    }


def _figures(chain: Chain, models: Models, frames: LimbTraining) -> dict[str, float]:
    """Return the RMS error of every segment and of the flexion of every inner joint, rad."""
    estimates, truth = _predictions(chain, models, frames), frames.reference
    found = {n: rms(rotation.angle_between(estimates[n], truth[n])) for n in chain.segments}
    for i, joint, proximal, distal in inner_joints(chain):
        above, below = chain.segments[proximal], chain.segments[distal]
        found[joint] = flexion_error(
            (estimates[above], estimates[below]),
            (truth[above], truth[below]),
            angle_convention(chain, i),
        )
    return found


def _rejection(figures: OnlineQuality) -> str | None:
    """Return the reason to reject the candidate because of its errors, or None."""
    before, after = figures.before_rad, figures.after_rad
    was, now = (float(np.mean([x**2 for x in f.values()])) ** 0.5 for f in (before, after))
    if now > min(GAIN * was, was - GAIN_RAD):
        return f"no improvement on the newest frames: error {_deg(now)}, was {_deg(was)}"
    for name, figure in after.items():
        if figure > before[name]:
            return (
                f"{name}: larger error on the newest frames: {_deg(figure)}, was "
                f"{_deg(before[name])}"
            )

    before = figures.known_before_rad
    for name, figure in figures.known_after_rad.items():
        if figure > WORSE * before[name] + WORSE_RAD:
            return (
                f"{name}: larger error on earlier frames: {_deg(figure)}, was {_deg(before[name])}"
            )
    return None


def _large_change(chain: Chain, old: Models, new: Models, known: LimbTraining) -> str | None:
    was, now = _predictions(chain, old, known), _predictions(chain, new, known)
    for name in chain.segments:
        moved = float(np.quantile(rotation.angle_between(was[name], now[name]), 0.95))
        if moved > MOST_CHANGE:
            return f"{name}: change of {_deg(moved)} in known postures"
    return None


def _deg(value: float) -> str:
    return f"{np.rad2deg(value):.2f} deg"
