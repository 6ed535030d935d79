"""Trials and unchanged OpenSim models that refined markers are judged on.

Law: what is learned from and what judges are told apart by name; a chain is made of the model
alone. All markers are let go, those that a model calls fixed included.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from bench.subjects.opensim_reference import judge, shared_markers, trial_frames
from jointfit_daemon.calibration.marker_refinement import MotionTrial
from jointfit_daemon.files.models import read_osim, to_z_up

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from bench.subjects.opensim_reference import Verdict
    from jointfit_daemon.files.mocap import MarkerTrajectories
    from jointfit_daemon.kinematics.chains import ChainModel

GAIT, OPENCAP = "opensim_gait2354", "opencap_subject4"
_WALK_S = (0.4, 1.6)
_STEPS = {"walking1": 1, "squats1": 10, "DJ1": 2, "STS1": 10}
"""Every so many frames are learned from; fewer judge."""


@dataclass(frozen=True, slots=True)
class Subject:
    """A model and trials of one person."""

    model: Path
    names: tuple[str, ...]
    trials: Mapping[str, MarkerTrajectories]
    """To learn from."""
    judged: Mapping[str, MarkerTrajectories]
    """The same trials, the frames that OpenSim judges."""

    def motion(self, name: str) -> MotionTrial:
        """Return a trial in our axes."""
        trial = self.trials[name]
        return MotionTrial(name, to_z_up(trial.positions), trial.rate_hz)

    def chain(self) -> ChainModel:
        """Return the chain of the model, all markers let go."""
        chain = read_osim(self.model).model
        at = {m.name: m for m in chain.markers}
        kept = tuple(replace(at[n], locked=(False, False, False)) for n in self.names)
        return replace(chain, markers=kept)

    def verdicts(
        self, trials: Sequence[str], refined: ChainModel | None = None
    ) -> dict[str, Verdict]:
        """Return what OpenSim says of the model as it is, or with refined markers."""
        return {name: judge(self.model, self.judged[name], refined) for name in trials}


def gait2354(data: Path) -> Subject:
    """Return OpenSim's example, scaled and its markers not placed: 73 frames, 31 markers."""
    folder = data / GAIT
    model, path = folder / "subject01_scaledOnly.osim", folder / "subject01_walk1.trc"
    names = shared_markers(model, path)
    whole = trial_frames(path, names)
    some = np.flatnonzero((whole.t_s > _WALK_S[0] - 1e-9) & (whole.t_s < _WALK_S[1] + 1e-9))
    walk = replace(
        whole,
        t_s=whole.t_s[some],
        frames=whole.frames[some],
        positions=whole.positions[some],
    )
    return Subject(model, names, {"walk1": walk}, {"walk1": walk})


def opencap(data: Path, coarser: int = 2, *, computed: bool = False) -> Subject:
    """Return OpenCap's subject 4, scaled by hand.

    Parameters
    ----------
    coarser
        One of so many frames that are learned from judges.
    computed
        The recording's computed hip centers count as markers: 45, not 43.
    """
    folder = data / OPENCAP
    model = folder / "models" / "manually_scaled.osim"
    paths = {name: folder / "trc" / f"{name}.trc" for name in _STEPS}
    hips = () if computed else ("R_HJC", "L_HJC")
    names = shared_markers(model, paths["walking1"], hips)
    return Subject(
        model,
        names,
        {n: trial_frames(paths[n], names, k) for n, k in _STEPS.items()},
        {n: trial_frames(paths[n], names, k * coarser) for n, k in _STEPS.items()},
    )
