"""A `Subject` that replays a `Recording`.

Invariant: the recording is not altered. During synthetic intervals (the blend between standing and
trial, the final pose) the cameras see no bones and the ground truth has no positions, so these
intervals enter neither training nor evaluation.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_simulators.body._limb import included_angle
from jointfit_simulators.body._motion_script import Step, UnknownMotionError
from jointfit_simulators.body._orientation import Rotation, from_wxyz, to_wxyz
from jointfit_simulators.body._posture import smootherstep
from jointfit_simulators.body._recorded_trial import (
    BONES,
    OPENCAP_CLUSTERS,
    InterpolatedTrack,
    interpolated_markers,
)
from jointfit_simulators.body._subject import GroundTruth, Observation

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from numpy.typing import NDArray

    from jointfit_simulators.body._recorded_trial import RecordedTrial

_STAND = "stand"
_MOTION = re.compile(r"stand|trial(@(?P<begin>[\d.]*)-(?P<end>[\d.]*))?")
_ROUNDING_S = 1e-6  # of instants that came through nanoseconds


class _Switch(NamedTuple):
    start_s: float
    name: str
    begin_s: float
    end_s: float
    """Part of the recording."""


class RecordedSubject:
    """The wearer of a recorded trial.

    Parameters
    ----------
    recording
        What is played.
    sensors
        Sensor ids and the segment each is worn on.
    steps
        ``stand``, ``trial`` and ``trial@A-B`` (its seconds A to B; either may be left out) in any
        order; the last one goes on for ever.
    start_s
        Instant of the first step.
    transition_s
        Length of the blend between them.
    clusters
        Markers of each body part; default: OpenCap's right leg, as far as recorded.
    """

    templates: Mapping[str, NDArray[np.float64]] = {}
    """None: the recording has bones for reference."""

    def __init__(
        self,
        recording: RecordedTrial,
        sensors: Mapping[str, str],
        steps: Iterable[Step],
        *,
        start_s: float = 0.0,
        transition_s: float = 1.5,
        clusters: Mapping[str, tuple[str, ...]] | None = None,
    ) -> None:
        self._recording = recording
        self._transition_s = transition_s
        missing = sorted(set(sensors) - set(recording.orientations.sensors))
        if missing:
            raise ValueError(f"the trial has no sensor {', '.join(missing)}")
        self.sensors = sensors
        trial = recording.orientations
        self._tracks = {
            name: InterpolatedTrack(trial.t_s, trial.sensors[name], rotation=True)
            for name in sensors
        }
        self._bones = {
            BONES[name.split("_")[0]]: (
                InterpolatedTrack(trial.t_s, turn, rotation=True),
                InterpolatedTrack(trial.t_s, trial.origins[name], rotation=False),
            )
            for name, turn in trial.bones.items()
            if name.split("_")[0] in BONES and name in trial.origins
        }
        self.visible_bones = tuple(self._bones)
        self._foothold = self._standing_origins()
        self._markers = interpolated_markers(recording.markers) if recording.markers else None
        self.clusters = self._known_clusters(clusters or OPENCAP_CLUSTERS)
        self._switches: list[_Switch] = []
        for step in steps:
            self.play(step.name, start_s)
            start_s += step.seconds

    def _standing_origins(self) -> Mapping[str, NDArray[np.float64]]:
        """Return where each bone's origin is while standing: as in the first frame, straightened.

        Each bone hangs where it hung on the one before, so that the joints stay whole.
        """
        first = np.zeros(1)
        found: dict[str, NDArray[np.float64]] = {}
        above: tuple[Rotation, NDArray[np.float64], NDArray[np.float64]] | None = None
        for name, (turns, origins) in self._bones.items():
            turn, origin = from_wxyz(turns.at(first)[0]), origins.at(first)[0]
            found[name] = origin
            if above is not None and self._recording.biases:
                found[name] = above[2] + above[0].inv().apply(origin - above[1])
            above = (turn, origin, found[name])
        return found

    def _known_clusters(
        self, clusters: Mapping[str, tuple[str, ...]]
    ) -> Mapping[str, tuple[str, ...]]:
        markers = self._recording.markers
        recorded = markers.names if markers else ()
        known = {part: names for part, names in clusters.items() if set(names) <= set(recorded)}
        clustered = {name for names in known.values() for name in names}
        self._columns = [recorded.index(name) for names in known.values() for name in names]
        others = tuple(name for name in recorded if name not in clustered)
        self._columns += [recorded.index(name) for name in others]
        return {**known, "other": others} if others else known

    @property
    def facts(self) -> Mapping[str, object]:
        """Length of the trial and what it holds, for the truth log."""
        return {"trial_s": self._recording.seconds, "bones": list(self._bones)}

    def play(self, name: str, t_s: float) -> None:
        """Stand, or begin the trial or a part of it anew; UnknownMotion for anything else."""
        part = _MOTION.fullmatch(name)
        if part is None:
            raise UnknownMotionError(
                f"no motion {name!r}; a trial has: stand, trial, trial@FROM-TO (s)"
            )
        whole_s = self._recording.seconds
        begin_s, end_s = float(part["begin"] or 0.0), min(float(part["end"] or whole_s), whole_s)
        if not begin_s < end_s:
            raise UnknownMotionError(f"no motion {name!r}; the trial is {whole_s:g} s long")
        self._switches = [s for s in self._switches if s.start_s < t_s]
        self._switches.append(_Switch(t_s, name, begin_s, end_s))

    def motion_at(self, t_s: float) -> str:
        """Return the name of the motion at an instant."""
        return self._switch(t_s).name

    def discard_before(self, t_s: float) -> None:
        """Nothing to forget: switches are few."""

    def _switch(self, t_s: float) -> _Switch:
        begun = [switch for switch in self._switches if switch.start_s <= t_s]
        return begun[-1] if begun else self._switches[0]

    def _place(self, t_s: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return time within the trial and share of it (1) against standing (0).

        The recording itself begins when it has faded in.
        """
        place, share = np.zeros_like(t_s), np.zeros_like(t_s)
        before = _STAND
        for start_s, name, begin_s, end_s in self._switches:
            begun = t_s >= start_s
            fade = smootherstep((t_s[begun] - start_s) / self._transition_s)
            if name == _STAND:
                share[begun] = 0.0 if before == _STAND else 1 - fade
            else:
                played = begin_s + t_s[begun] - start_s - self._transition_s
                place[begun] = np.clip(played, begin_s, end_s)
                share[begun] = np.maximum(fade, 0.0 if before == _STAND else share[begun])
            before = name
        return place, share

    def _made_up(self, t_s: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Return when neither the static pose nor the recording is played."""
        made_up = np.zeros(len(t_s), dtype=np.bool_)
        before = _STAND
        for start_s, name, begin_s, end_s in self._switches:
            begun = t_s >= start_s
            since = t_s[begun] - start_s - self._transition_s
            blending = since < -_ROUNDING_S
            if name == _STAND:
                made_up[begun] = blending & (before != _STAND)
            else:
                made_up[begun] = blending | (since > end_s - begin_s + _ROUNDING_S)
            before = name
        return made_up

    def observe(
        self,
        sensors: Sequence[NDArray[np.float64]],
        cameras: NDArray[np.float64],
        truth: NDArray[np.float64],
    ) -> Observation:
        """Return what is to be seen."""
        seen = [self._sensor(name, t) for name, t in zip(self.sensors, sensors, strict=True)]
        place, _ = self._place(cameras)
        markers = np.empty((len(cameras), 0, 3))
        if self._markers is not None:
            recorded = self._markers.at(place).reshape(len(cameras), len(self._columns), 3)
            markers = recorded[:, self._columns]
        bones = {name: self._bone(name, cameras) for name in self._bones}
        return Observation(seen, markers, bones, self._truth(truth))

    def _sensor(self, name: str, t_s: NDArray[np.float64]) -> NDArray[np.float64]:
        bias = self._recording.biases.get(name)
        still = self._tracks[name].at(np.zeros(1))[0] if bias is None else bias * [1, -1, -1, -1]
        return self._faded(self._tracks[name], still, t_s)

    def _bone(self, name: str, t_s: NDArray[np.float64]) -> tuple[Rotation, NDArray[np.float64]]:
        turns, origins = self._bones[name]
        upright = np.array([1.0, 0.0, 0.0, 0.0])
        still = upright if self._recording.biases else turns.at(np.zeros(1))[0]
        place, share = self._place(t_s)
        where = share[:, None] * origins.at(place) + (1 - share[:, None]) * self._foothold[name]
        where[self._made_up(t_s)] = np.nan
        return from_wxyz(self._faded(turns, still, t_s)), where

    def _faded(
        self, track: InterpolatedTrack, still: NDArray[np.float64], t_s: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return a track blended with its still value along the shortest arc."""
        place, share = self._place(t_s)
        moving = track.at(place)
        fading = (share < 1) & np.isfinite(moving[:, 0])
        if np.any(fading):
            rest = from_wxyz(still)
            arc = (rest.inv() * from_wxyz(moving[fading])).as_rotvec() * share[fading, None]
            moving[fading] = to_wxyz(rest * Rotation.from_rotvec(arc))
        return moving

    def _truth(self, t_s: NDArray[np.float64]) -> GroundTruth:
        bones = {name: self._bone(name, t_s) for name in self._bones}
        nothing = np.full((len(t_s), 3), np.nan)
        joints = {"hip": nothing, "knee": nothing, "ankle": nothing}
        joints |= {
            joint: bones[part][1]
            for joint, part in (("hip", "thigh"), ("knee", "shank"))
            if part in bones
        }
        turns = {name: turn for name, (turn, _) in bones.items()}
        if not {"thigh", "shank"} <= set(turns) or not len(t_s):
            return GroundTruth(turns, joints, nothing, nothing[:, 0])
        knee = (turns["thigh"].inv() * turns["shank"]).as_euler("XYZ") * [-1, 1, 1]
        return GroundTruth(turns, joints, knee, included_angle(turns["thigh"], turns["shank"]))
