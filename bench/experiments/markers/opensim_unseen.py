"""Markers refined on all movements but one, and evaluated by OpenSim on the remaining movement.

No setting is chosen on the evaluated movements. The prior, the weights and the loss of the
refinement are those of the other experiments with OpenSim.
"""

from __future__ import annotations

from math import inf
from typing import TYPE_CHECKING

import numpy as np

from bench.experiments.markers.opensim import EVERYTHING
from bench.framework.experiment import Experiment, Result
from bench.framework.material import OPENSIM_OPENCAP
from bench.subjects.opensim_trials import OPENCAP, opencap, opencap_legs
from jointfit_daemon.calibration.marker_refinement import RefinementSettings, refine_markers
from jointfit_daemon.files.axes import to_z_up
from jointfit_daemon.kinematics.inverse_kinematics import (
    IkOptions,
    restart_local_minima,
    solve_frames,
)

if TYPE_CHECKING:
    from pathlib import Path

    from bench.subjects.opensim_trials import OpensimSubject
    from jointfit_daemon.arrays import Array
    from jointfit_daemon.kinematics.chains import ChainModel

_MM, _MM2 = 1000.0, 1e6
_SETTINGS = RefinementSettings(huber_m=None, frames=40)
_STUCK_M = 0.001
"""If OpenSim's RMS error in a frame exceeds the error of the restarted solution by more than this
value, m, OpenSim's solution is counted as a local minimum."""


def every_movement(data: Path) -> list[Result]:
    """Refine markers of pelvis and legs on static pose and three movements; evaluate the fourth."""
    subject = opencap_legs(data)
    figures, errors, stuck = [], [], 0
    for name in EVERYTHING:
        trained = [n for n in subject.trials if n != name]
        found = refine_markers(subject.chain(), [subject.motion(n) for n in trained], _SETTINGS)
        before = subject.verdicts([name])[name]
        after = subject.verdicts([name], found.model)[name]
        stuck += _stuck(subject, name, subject.chain(), before.frame_rms)
        stuck += _stuck(subject, name, found.model, after.frame_rms)

        errors.append((before.rms, after.rms))
        figures += [
            Result(f"{name}: before", _MM * before.rms, inf, unit="mm"),
            Result(f"{name}, not trained: after", _MM * after.rms, inf, unit="mm"),
            Result(f"{name}: reduction", _less(before.rms, after.rms), inf, unit="%"),
        ]

    was, now = np.array(errors).T
    torso = _share_of_torso_and_arms(data)
    return [
        *figures,
        Result("mean of movements: reduction", _less(was.mean(), now.mean()), inf, 38, "%"),
        Result("variance across movements: before", _MM2 * was.var(), inf, unit="mm²"),
        Result("variance across movements: after", _MM2 * now.var(), inf, unit="mm²"),
        Result("variance across movements: reduction", _less(was.var(), now.var()), inf, 50, "%"),
        Result("frames of OpenSim in a local minimum", stuck, 0, unit=""),
        *(
            Result(
                f"whole body, {name}: share of torso and arms in the squared error",
                share,
                inf,
                unit="",
            )
            for name, share in torso.items()
        ),
    ]


def _less(before: float, after: float) -> float:
    return 100.0 * (1.0 - after / before)


def _squared(subject: OpensimSubject, name: str, model: ChainModel) -> Array:
    """Return the squared marker errors of the restarted solution, m², shape (frames, markers).

    This project's inverse kinematics is restarted from other poses to leave local minima.
    """
    targets = to_z_up(subject.judged[name].positions)
    weights = np.isfinite(targets).all(axis=-1).astype(float)
    options = IkOptions(limit_m2=_SETTINGS.limit_m2)
    found = solve_frames(model, targets, weights, options=options)
    found, _ = restart_local_minima(model, targets, weights, found, options)
    return np.asarray((found.residuals**2).sum(axis=-1))


def _stuck(subject: OpensimSubject, name: str, model: ChainModel, judged: Array) -> int:
    """Return the number of frames in which OpenSim is in a local minimum."""
    ours = np.sqrt(np.nanmean(_squared(subject, name, model), axis=1))
    return int(np.count_nonzero(judged > ours + _STUCK_M))


def _share_of_torso_and_arms(data: Path) -> dict[str, float]:
    """Return the share of the 13 markers of torso and arms in the squared error, by movement.

    The model of the whole body has 43 markers. Their positions are not refined.
    """
    whole, legs = opencap(data), set(opencap_legs(data).names)
    upper = [i for i, name in enumerate(whole.names) if name not in legs]
    shares = {}
    for name in ("walking1", "DJ1"):
        squared = _squared(whole, name, whole.chain())
        shares[name] = float(np.nansum(squared[:, upper]) / np.nansum(squared))
    return shares


WALKING = (
    "walking improves least, because soft tissue displaces the thigh markers differently "
    "in walking than in the movements used for the refinement (squats, jump, sit-to-stand "
    "and static pose)"
)
EVEN = (
    "walking and the jump improve less than squats and sit-to-stand if they are not trained; no "
    "frame was in a local minimum of inverse kinematics"
)
EXPERIMENTS = (
    Experiment(
        "opensim-every-movement-unseen",
        "Markers of pelvis and legs, refined on all movements but one: error of this "
        "movement in OpenSim's inverse kinematics",
        every_movement,
        OPENSIM_OPENCAP,
        (OPENCAP,),
        ("opensim",),
        long=True,
        known_misses={
            "mean of movements: reduction": WALKING,
            "variance across movements: reduction": EVEN,
        },
    ),
)
