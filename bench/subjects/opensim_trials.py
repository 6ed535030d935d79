"""Trials and unchanged OpenSim models for the evaluation of refined markers.

Invariant: a chain is made from the model alone. All markers are free, including markers that a
model marks as fixed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from bench.subjects.opensim_reference import judge, shared_markers, trial_frames
from jointfit_daemon.calibration.marker_refinement import MotionTrial
from jointfit_daemon.files.axes import to_z_up
from jointfit_daemon.files.models import read_osim

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from bench.subjects.opensim_reference import Verdict
    from jointfit_daemon.files.mocap import MarkerTrajectories
    from jointfit_daemon.kinematics.chains import ChainModel

GAIT, OPENCAP = "opensim_gait2354", "opencap_subject4"
_WALK_S = (0.4, 1.6)
_LEGS = ("pelvis", "femur", "tibia", "talus", "calcn", "toes")
_STATIC, _STATIC_STEP = "static1", 10
_STEPS = {"walking1": 1, "squats1": 10, "DJ1": 2, "STS1": 10}
"""Step between training frames, by trial. The evaluation uses fewer frames."""


@dataclass(frozen=True, slots=True)
class OpensimSubject:
    """Model and trials of one subject."""

    model: Path
    names: tuple[str, ...]
    trials: Mapping[str, MarkerTrajectories]
    """Frames for training, by trial."""
    judged: Mapping[str, MarkerTrajectories]
    """Frames of the same trials for evaluation by OpenSim, by trial."""

    def motion(self, name: str) -> MotionTrial:
        """Return a trial in the axes of this project."""
        trial = self.trials[name]
        return MotionTrial(name, to_z_up(trial.positions), trial.rate_hz)

    def chain(self) -> ChainModel:
        """Return the chain of the model with all markers free."""
        chain = read_osim(self.model).model
        at = {m.name: m for m in chain.markers}
        kept = tuple(replace(at[n], locked=(False, False, False)) for n in self.names)
        return replace(chain, markers=kept)

    def verdicts(
        self, trials: Sequence[str], refined: ChainModel | None = None
    ) -> dict[str, Verdict]:
        """Return the errors of OpenSim with the markers of the model or with refined markers."""
        return {name: judge(self.model, self.judged[name], refined) for name in trials}


def gait2354(data: Path) -> OpensimSubject:
    """Return the scaled example of OpenSim with unadjusted markers: 73 frames, 31 markers."""
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
    return OpensimSubject(model, names, {"walk1": walk}, {"walk1": walk})


def opencap_legs(data: Path) -> OpensimSubject:
    """Return OpenCap subject 4 with the 30 markers of pelvis and legs, and with a static pose."""
    whole = opencap(data)
    keep = [i for i, m in enumerate(whole.chain().markers) if m.segment.startswith(_LEGS)]
    names = tuple(whole.names[i] for i in keep)
    static = data / OPENCAP / "trc" / f"{_STATIC}.trc"

    def of_legs(trials: Mapping[str, MarkerTrajectories]) -> dict[str, MarkerTrajectories]:
        return {
            name: replace(trial, names=names, positions=trial.positions[:, keep])
            for name, trial in trials.items()
        }

    training = {**of_legs(whole.trials), _STATIC: trial_frames(static, names, _STATIC_STEP)}
    return OpensimSubject(whole.model, names, training, of_legs(whole.judged))


def opencap(data: Path, coarser: int = 2, *, computed: bool = False) -> OpensimSubject:
    """Return OpenCap subject 4 with a manually scaled model.

    Parameters
    ----------
    coarser
        Ratio of training frames to evaluated frames.
    computed
        Whether to use the computed hip centers of the recording as markers. The trials then have 45
        instead of 43 markers.
    """
    folder = data / OPENCAP
    model = folder / "models" / "manually_scaled.osim"
    paths = {name: folder / "trc" / f"{name}.trc" for name in _STEPS}
    hips = () if computed else ("R_HJC", "L_HJC")
    names = shared_markers(model, paths["walking1"], hips)
    return OpensimSubject(
        model,
        names,
        {n: trial_frames(paths[n], names, k) for n, k in _STEPS.items()},
        {n: trial_frames(paths[n], names, k * coarser) for n, k in _STEPS.items()},
    )
