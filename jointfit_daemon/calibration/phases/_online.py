"""Learning on: newer frames with cameras make better models, or none at all.

Law: pure; models only, never mounts, joints or lags. A candidate is fitted to what the calibration
was taught with and the older part of what is new, and judged on the newest part, which it has not
seen, beside the models in force. Not better, much worse on what was known, far away from what was
said, or cameras that contradict the sensors: nothing is taken, and the reason is said.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.calibration._errors import CalibrationRefused
from jointfit_daemon.calibration.soft_tissue import (
    LimbTraining,
    error_correlations,
    evenly,
    fit_models,
    fit_segment,
    flexion,
    joined,
    mean_of,
    pack,
    unpack,
)
from jointfit_daemon.kinematics import rotation
from jointfit_daemon.limb_model import alive_key, live_cluster, neighbor, rigid_fit

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.calibration._trial import Fresh
    from jointfit_daemon.limb_model import Calibration, Method
    from jointfit_daemon.model import Chain


FEWEST = 200
HELD = 0.3
"""Newest share of the new frames, contiguous, which judges."""
GAIN, GAIN_RAD = 0.97, np.deg2rad(0.05)
"""What is taken is better by so much on the newest frames: less is chance, or not worth it."""
WORSE, WORSE_RAD = 1.15, np.deg2rad(0.3)
"""How much worse any single figure may become, as when a whole calibration is judged."""
MOST_CHANGE = np.deg2rad(8.0)
"""95 % of the corrections in known postures may change by no more: skin does not change faster."""
MARKERS_RMS_M = 0.015
"""Of a frame's markers about their places on the body part; worse are left out."""
MOST_LEFT_OUT = 0.3
CONTRADICTED = np.deg2rad(8.0)
"""Median distance of cameras from the models in force from which on one of them is not believed."""
SHIFTED = np.deg2rad(5.0)
"""The same of their mean: a cluster that sits elsewhere on its segment."""
TURN_FRAMES = 150
"""Frames over which a heading's wandering is taken for constant: 15 s."""


def learn(
    calibration: Calibration, fresh: Fresh, chain: Chain, *, software: str = ""
) -> dict[str, Any]:
    """Fit better models to new frames.

    Parameters
    ----------
    calibration : Calibration
        In force; its ``memory`` holds what it was taught with.
    fresh : Fresh
        What came since.

    Returns
    -------
    dict
        ``quality`` with ``online``: what was judged, before and after, rad; and either
        ``calibration`` (JSON form) or ``kept``: why the models in force stay.

    Raises
    ------
    CalibrationRefused
        Too little, no memory, or cameras that contradict themselves or the sensors.
    """
    known = unpack(chain, calibration.memory)
    if known is None:
        raise CalibrationRefused("no memory of its movement: run the functional phase once more")
    new = _believed(calibration, _reference(calibration, fresh, chain), chain)
    cut = round(len(new) * (1.0 - HELD))
    older, newest = new.part(slice(None, cut)), new.part(slice(cut, None))
    candidate = _all_alive(chain, joined(known, evenly(chain, older)), calibration.method)
    in_force = _in_force(calibration, chain)
    before, after = _figures(chain, in_force, newest), _figures(chain, candidate, newest)
    known_before, known_after = _figures(chain, in_force, known), _figures(chain, candidate, known)
    figures: dict[str, Any] = {
        "frames": len(new),
        "judged": len(newest),
        "before_rad": before,
        "after_rad": after,
        "known_before_rad": known_before,
        "known_after_rad": known_after,
    }
    kept = (
        _not_better(before, after)
        or _forgotten(known_before, known_after)
        or _too_far(chain, in_force, candidate, known)
    )
    if kept is not None:
        return {"quality": {"online": figures}, "kept": kept}
    whole = evenly(chain, joined(known, new))
    models = fit_models(chain, whole, calibration.method)
    rounds = int(calibration.quality.get("online", {}).get("rounds", 0)) + 1
    figures |= {"rounds": rounds, "software": software, "taught": calibration.digest}
    segments = {
        name: replace(item, models=models[name]) for name, item in calibration.segment.items()
    }
    found = replace(
        calibration,
        segment=segments,
        correlations=error_correlations(chain, whole, calibration.method),
        memory=pack(chain, whole),
        quality={**calibration.quality, "online": figures},
    )
    return {"quality": dict(found.quality), "calibration": found.to_dict()}


# --- the cameras ------------------------------------------------------------------------------


def _reference(calibration: Calibration, fresh: Fresh, chain: Chain) -> LimbTraining:
    """Return the frames whose markers sit where they should, with what they say of each segment."""
    reference = {}
    for name in chain.segments:
        cluster = live_cluster(name, calibration.clusters[name])
        if cluster.body is not None:
            turn = rotation.multiply(fresh.bodies[name], rotation.conjugate(cluster.q_body))
        else:
            turn, _, rms = rigid_fit(cluster.template, fresh.markers[name])
            turn[~(rms <= MARKERS_RMS_M)] = np.nan
        good = float(np.isfinite(turn[:, 0]).mean()) if len(turn) else 0.0
        if good < 1.0 - MOST_LEFT_OUT:
            raise CalibrationRefused(
                f"{name}: in {100 * (1 - good):.0f} % of the frames its markers are not where they "
                "were: check their names, and whether one moved"
            )
        q_static = np.array(calibration.segment[name].q_static)
        reference[name] = rotation.multiply(turn, q_static)
    whole = np.all([np.isfinite(q).all(axis=1) for q in reference.values()], axis=0)
    if np.count_nonzero(whole) < FEWEST:
        raise CalibrationRefused(f"{np.count_nonzero(whole)} whole frames, {FEWEST} are needed")
    return LimbTraining(dict(fresh.sensors), reference).rows(whole)


def _believed(calibration: Calibration, new: LimbTraining, chain: Chain) -> LimbTraining:
    """Return the frames with slow turns of heading taken out; refuse cameras not to be believed.

    Headings of sensors wander for minutes, a matter of no posture: what of the difference between
    cameras and models turns about the vertical, mean of 15 s, is taken out of the reference.
    """
    said = _said(chain, _in_force(calibration, chain), new)
    reference = {}
    for name in chain.segments:
        q = _unturned(new.reference[name], said[name])
        off = rotation.log(rotation.multiply(rotation.conjugate(said[name]), q))
        apart = float(np.median(np.linalg.norm(off, axis=1)))
        shift = float(np.linalg.norm(np.median(off, axis=0)))
        if apart > CONTRADICTED or shift > SHIFTED:
            raise CalibrationRefused(
                f"{name}: cameras and sensors contradict each other by {np.rad2deg(apart):.1f} deg "
                f"({np.rad2deg(shift):.1f} constantly): check marker names, or repeat the static "
                "pose"
            )
        reference[name] = q
    return LimbTraining(new.sensors, reference)


def _unturned(reference: Array, said: Array) -> Array:
    off = rotation.log(rotation.multiply(reference, rotation.conjugate(said)))
    out = reference.copy()
    for rows in np.array_split(np.arange(len(out)), max(len(out) // TURN_FRAMES, 1)):
        turn = rotation.heading(np.array(-float(np.median(off[rows, 2]))))
        out[rows] = rotation.multiply(turn, reference[rows])
    return out


# --- models and their judgement ---------------------------------------------------------------

Models = dict[str, Any]


def _in_force(calibration: Calibration, chain: Chain) -> Models:
    found = {}
    for i, name in enumerate(chain.segments):
        near = "+".join(neighbor(chain, i)) or None
        found[name] = calibration.segment[name].models[alive_key(chain.sensors[i], near)]
    return found


def _all_alive(chain: Chain, training: LimbTraining, method: Method) -> Models:
    found = {}
    for i, name in enumerate(chain.segments):
        near = neighbor(chain, i)
        found[name] = fit_segment(
            method,
            [training.sensors[s] for s in chain.sensors[i]],
            mean_of(training, near) if near else None,
            training.reference[name],
            training.trials,
        )
    return found


def _said(chain: Chain, models: Models, frames: LimbTraining) -> dict[str, Array]:
    out = {}
    for i, name in enumerate(chain.segments):
        near = neighbor(chain, i)
        sensors = [frames.sensors[s] for s in chain.sensors[i]]
        out[name] = models[name].predict(sensors, mean_of(frames, near) if near else None)
    return out


def _figures(chain: Chain, models: Models, frames: LimbTraining) -> dict[str, float]:
    """Return the RMS error of every segment and of every inner joint's flexion, rad."""
    said, truth = _said(chain, models, frames), frames.reference
    found = {n: _rms(rotation.angle_between(said[n], truth[n])) for n in chain.segments}
    for i, joint in enumerate(chain.joints[1:-1]):
        above, below = chain.segments[i], chain.segments[i + 1]
        off = flexion(said[above], said[below]) - flexion(truth[above], truth[below])
        found[joint] = _rms(np.arctan2(np.sin(off), np.cos(off)))
    return found


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _not_better(before: Mapping[str, float], after: Mapping[str, float]) -> str | None:
    was, now = (float(np.mean([x**2 for x in f.values()])) ** 0.5 for f in (before, after))
    if now > min(GAIN * was, was - GAIN_RAD):
        return f"no better on the newest frames: {_deg(now)}, was {_deg(was)}"
    for name, figure in after.items():
        if figure > before[name]:
            return f"{name}: worse on the newest frames: {_deg(figure)}, was {_deg(before[name])}"
    return None


def _forgotten(before: Mapping[str, float], after: Mapping[str, float]) -> str | None:
    for name, figure in after.items():
        if figure > WORSE * before[name] + WORSE_RAD:
            return f"{name}: what was known got worse: {_deg(figure)}, was {_deg(before[name])}"
    return None


def _too_far(chain: Chain, old: Models, new: Models, known: LimbTraining) -> str | None:
    was, now = _said(chain, old, known), _said(chain, new, known)
    for name in chain.segments:
        moved = float(np.quantile(rotation.angle_between(was[name], now[name]), 0.95))
        if moved > MOST_CHANGE:
            return f"{name}: would change by {_deg(moved)} in known postures"
    return None


def _deg(value: float) -> str:
    return f"{np.rad2deg(value):.2f} deg"
