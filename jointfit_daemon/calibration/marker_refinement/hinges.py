"""How far movements turn the hinges of a chain.

Law: a joint that is no hinge can be near to one over a part of its range; this says over which.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.kinematics.chain_motion import hinge_angles
from jointfit_daemon.kinematics.inverse_kinematics import IkOptions, solve_frames

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.calibration.marker_refinement.motion import MotionTrial
    from jointfit_daemon.kinematics.chain_model import ChainModel

_FRAMES = 150
_ENDS = (0.02, 0.98)
"""Quantiles of a trial that count as its range: single wrong frames are not followed."""
_WITHIN = IkOptions(limit_m2=1.0)


def used_ranges(model: ChainModel, trials: Sequence[MotionTrial]) -> dict[str, tuple[float, float]]:
    """Return lowest and highest angle of every hinge in any of the trials, rad, by segment."""
    ends: dict[str, list[float]] = {}
    for trial in trials:
        targets = trial.thinned(_FRAMES).targets
        shown = np.isfinite(targets).any(axis=(1, 2))
        if not shown.any():
            continue
        state = solve_frames(model, targets[shown], options=_WITHIN).state
        for name, angles in hinge_angles(model, state).items():
            ends.setdefault(name, []).extend(np.quantile(angles, _ENDS).tolist())
    return {name: (min(found), max(found)) for name, found in ends.items()}
