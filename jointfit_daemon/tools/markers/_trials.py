"""Input of `jointfit markers`: a chain model, and trials in the marker order of the model.

Positions of markers that are missing in a trial are NaN. Unknown names in options raise
`ValueError`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

from jointfit_daemon.calibration.marker_refinement import (
    require_marker,
    with_locks,
    with_weights,
)
from jointfit_daemon.files.mocap import read_marker_trial
from jointfit_daemon.files.models import load_model, read_marker_weights
from jointfit_daemon.tools.marker_model import motion_trial

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.calibration.marker_refinement import MotionTrial
    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.kinematics.chains import ChainModel


@dataclass(frozen=True, slots=True)
class ModelRequest:
    """Command-line options of `jointfit markers` that change the chain model."""

    model: Path
    lock: tuple[str, ...] = ()
    unlock: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    up: str | None = None
    weights: Path | None = None


def load(
    asked: ModelRequest, trials: Sequence[Path], validation: Sequence[Path]
) -> tuple[ChainModel, tuple[str, ...], list[MotionTrial], list[MotionTrial]]:
    """Return the chain model, notes from its import, training trials and validation trials.

    Raises
    ------
    ValueError
        A name in an option is unknown. A damaged file raises the subclass `MalformedFileError`.
    """
    read = [read_marker_trial(path, cast("Axis | None", asked.up)) for path in trials]
    validations = [read_marker_trial(path, cast("Axis | None", asked.up)) for path in validation]
    loaded = load_model(asked.model)
    chain = loaded.chain
    for name in asked.without:
        require_marker(chain, name, "--without")
    kept = tuple(m for m in chain.markers if m.name not in asked.without)
    chain = replace(chain, markers=kept)
    if asked.weights is not None:
        weights = read_marker_weights(asked.weights)
        chain = with_weights(chain, weights, f"--weights {asked.weights}:")

    learned = [motion_trial(p.stem, t, chain) for p, t in zip(trials, read, strict=True)]
    chain = with_locks(chain, asked.unlock, "--unlock", locked=False)
    chain = with_locks(chain, asked.lock, "--lock", locked=True)
    held_out = [
        motion_trial(p.stem, t, chain) for p, t in zip(validation, validations, strict=True)
    ]
    return chain, loaded.remarks, learned, held_out
