"""Input of `jointfit markers`: a chain model, and trials with columns in its marker order.

Markers that a trial lacks are NaN there. Unknown names in options raise `ValueError`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

from jointfit_daemon.files.mocap import read_marker_trial
from jointfit_daemon.files.models import load_model, read_marker_weights
from jointfit_daemon.tools.marker_model import motion_trial, require_marker

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from jointfit_daemon.calibration.marker_refinement import MotionTrial
    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.kinematics.chains import ChainModel

_AXES = "xyz"
_ALL = "*"


@dataclass(frozen=True, slots=True)
class ModelRequest:
    """Model options of the command line."""

    model: Path
    lock: tuple[str, ...] = ()
    unlock: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    up: str | None = None
    weights: Path | None = None


def load(
    asked: ModelRequest, trials: Sequence[Path], validation: Sequence[Path]
) -> tuple[ChainModel, tuple[str, ...], list[MotionTrial], list[MotionTrial]]:
    """Return the chain, remarks of its import, training trials and validation trials.

    Raises
    ------
    ValueError
        Unknown names in locks; `MalformedFileError` for broken files.
    """
    read = [read_marker_trial(path, cast("Axis | None", asked.up)) for path in trials]
    judges = [read_marker_trial(path, cast("Axis | None", asked.up)) for path in validation]
    loaded = load_model(asked.model)
    chain = loaded.chain
    for name in asked.without:
        require_marker(chain, name, "--without")
    kept = tuple(m for m in chain.markers if m.name not in asked.without)
    chain = replace(chain, markers=kept)
    if asked.weights is not None:
        chain = _weighted(chain, asked.weights)

    learned = [motion_trial(p.stem, t, chain) for p, t in zip(trials, read, strict=True)]
    chain = _locked(chain, asked.unlock, hold=False)
    chain = _locked(chain, asked.lock, hold=True)
    judged = [motion_trial(p.stem, t, chain) for p, t in zip(validation, judges, strict=True)]
    return chain, loaded.remarks, learned, judged


def _weighted(chain: ChainModel, path: Path) -> ChainModel:
    """Return the chain with the weights of a file; other markers keep theirs."""
    weights = read_marker_weights(path)
    for name in weights:
        require_marker(chain, name, f"--weights {path}:")
    if not any(weights.get(m.name, m.weight) > 0.0 for m in chain.markers):
        raise ValueError(f"--weights {path}: every weight is 0, expected some above 0")
    markers = (replace(m, weight=weights.get(m.name, m.weight)) for m in chain.markers)
    return replace(chain, markers=tuple(markers))


def _locked(chain: ChainModel, texts: Iterable[str], *, hold: bool) -> ChainModel:
    """Return the chain with the named locks set (`hold`) or cleared."""
    locks = {m.name: list(m.locked) for m in chain.markers}
    for text in texts:
        if text == _ALL:
            locks = {name: [hold] * 3 for name in locks}
            continue
        # A full marker name with a dot takes precedence over a marker and its coordinate.
        name, dot, axis = text.rpartition(".")
        if text in locks or not dot or axis not in tuple(_AXES):
            name, axis = text, _AXES
        require_marker(chain, name, "--lock" if hold else "--unlock")
        for letter in axis:
            locks[name][_AXES.index(letter)] = hold

    return chain.with_locks({name: (x, y, z) for name, (x, y, z) in locks.items()})
