"""Conversion of marker trials to the marker order of a chain model.

Positions of markers that are missing in a trial are NaN.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.marker_refinement import MotionTrial
from jointfit_daemon.files.mocap import UnknownMarkerError

if TYPE_CHECKING:
    from jointfit_daemon.files.mocap import MarkerTrial
    from jointfit_daemon.kinematics.chains import ChainModel


def motion_trial(name: str, trial: MarkerTrial, chain: ChainModel) -> MotionTrial:
    """Return the positions of the model's markers in a trial; missing markers are NaN."""
    count = len(trial.trajectories.t_s)
    targets = np.full((count, len(chain.markers), 3), np.nan)
    for at, marker in enumerate(chain.marker_names):
        try:
            targets[:, at] = trial.points([marker])[:, 0]
        except UnknownMarkerError:
            continue  # the column remains NaN, which the caller reports
    return MotionTrial(name, targets, trial.trajectories.rate_hz)
