"""Input that commands on marker trials share: marker names, and trials in a model's marker order.

Markers that a trial lacks are NaN there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.calibration.marker_refinement import MotionTrial
from jointfit_daemon.files.mocap import UnknownMarkerError
from jointfit_daemon.nearest_name import did_you_mean

if TYPE_CHECKING:
    from jointfit_daemon.files.mocap import MarkerTrial
    from jointfit_daemon.kinematics.chains import ChainModel


def require_marker(chain: ChainModel, name: str, option: str) -> None:
    """Check the marker name in an option.

    Raises
    ------
    ValueError
        The model has no such marker.
    """
    if name in chain.marker_names:
        return
    names = chain.marker_names
    hint = did_you_mean(name, names, count=3) or f"there are: {', '.join(names)}"
    raise ValueError(f"{option} {name}: unknown marker; {hint}")


def motion_trial(name: str, trial: MarkerTrial, chain: ChainModel) -> MotionTrial:
    """Return the markers of the model in a trial, NaN where missing."""
    count = len(trial.trajectories.t_s)
    targets = np.full((count, len(chain.markers), 3), np.nan)
    for at, marker in enumerate(chain.marker_names):
        try:
            targets[:, at] = trial.points([marker])[:, 0]
        except UnknownMarkerError:
            continue  # the column remains NaN, which the caller reports
    return MotionTrial(name, targets, trial.trajectories.rate_hz)
