"""Subject that replays a `RecordedTrial`.

Invariant: the recording is not changed. The blend between standing and trial, and the final pose,
are synthetic. During synthetic intervals, the cameras return no bones and the ground truth has no
positions. These intervals therefore enter neither training nor evaluation.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_simulators.body._limb import included_angle
from jointfit_simulators.body._limb_kinds import LEG_CHAIN
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

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body._recorded_trial import RecordedTrial

_STAND = "stand"
_MOTION = re.compile(r"stand|trial(@(?P<begin>[\d.]*)-(?P<end>[\d.]*))?")
_ROUNDING_S = 1e-6
"""Rounding error of times that were converted from nanoseconds, s."""
_FIRST = np.zeros(1)
"""Time of the first recorded frame, s, shape (1,)."""


class _Switch(NamedTuple):
    """Start of a motion, which plays the recording from `begin_s` to `end_s`."""

    start_s: float
    name: str
    begin_s: float
    end_s: float


class RecordedSubject:
    """Subject of a recorded trial.

    Parameters
    ----------
    recording
        Trial to replay.
    sensors
        Segment of each sensor, by sensor id.
    steps
        Steps in any order: ``stand``, ``trial`` and ``trial@A-B``. The last form plays the trial
        from A to B, s; A or B may be omitted. The last step continues until the end.
    start_s
        Start of the first step, s.
    transition_s
        Duration of the blend between steps, s.
    clusters
        Markers of each body part. The default is the recorded markers of OpenCap's right leg.
    """

    templates: Mapping[str, Array] = {}
    """Marker templates of rigid bodies. They are empty, because the reference of a recording is its
    bones."""
    chain = LEG_CHAIN
    """Kinematic chain of the recorded limb, which is always a leg."""

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
        self._standing_origins = self._place_standing_bones()
        self._markers = interpolated_markers(recording.markers) if recording.markers else None
        self.clusters = self._recorded_clusters(clusters or OPENCAP_CLUSTERS)

        self._switches: list[_Switch] = []
        for step in steps:
            self.play(step.name, start_s)
            start_s += step.seconds

    def _place_standing_bones(self) -> Mapping[str, Array]:
        """Return the origins of the bones while standing.

        Each bone has the same position relative to the proximal bone as in the first frame. The
        joints therefore remain connected when the bones are upright.
        """
        placed: dict[str, Array] = {}
        above: tuple[Rotation, Array, Array] | None = None
        for name, (turns, origins) in self._bones.items():
            turn, origin = from_wxyz(turns.at(_FIRST)[0]), origins.at(_FIRST)[0]
            placed[name] = origin
            if above is not None and self._recording.biases:
                placed[name] = above[2] + above[0].inv().apply(origin - above[1])
            above = (turn, origin, placed[name])
        return placed

    def _recorded_clusters(
        self, clusters: Mapping[str, tuple[str, ...]]
    ) -> Mapping[str, tuple[str, ...]]:
        """Return the recorded markers by part; store the index of each in the recording."""
        markers = self._recording.markers
        recorded = markers.names if markers else ()
        known = {part: names for part, names in clusters.items() if set(names) <= set(recorded)}
        clustered = {name for names in known.values() for name in names}
        others = tuple(name for name in recorded if name not in clustered)
        if others:
            known["other"] = others
        self._columns = [recorded.index(name) for names in known.values() for name in names]
        return known

    @property
    def facts(self) -> Mapping[str, object]:
        """Duration and bones of the trial, for the ground-truth log."""
        return {"trial_s": self._recording.seconds, "bones": list(self._bones)}

    def play(self, name: str, t_s: float, *, at_once: bool = False) -> None:
        """Start ``stand``, ``trial`` or a part of the trial, always with a blend.

        Raises
        ------
        UnknownMotionError
            `name` is another motion, or the motion should start at once.
        """
        if at_once:
            raise UnknownMotionError("the motions of a trial always begin with a blend")
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
        """Return the name of the motion at the time `t_s`."""
        begun = [switch for switch in self._switches if switch.start_s <= t_s]
        return (begun[-1] if begun else self._switches[0]).name

    def discard_before(self, t_s: float) -> None:
        """Do nothing, because the number of stored motions is small."""

    def _place(self, t_s: Array) -> tuple[Array, Array]:
        """Return the time within the trial, s, and the weight of the trial relative to standing.

        The weight is 1 for the trial and 0 for standing. The recording starts after the blend.
        During the blend, its first posture is used.
        """
        place, share = np.zeros_like(t_s), np.zeros_like(t_s)
        before = _STAND
        for start_s, name, begin_s, end_s in self._switches:
            # From its start on, a motion replaces all earlier motions.
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

    def _synthetic(self, t_s: Array) -> NDArray[np.bool_]:
        """Return for each time whether neither the static pose nor the recording plays."""
        synthetic = np.zeros(len(t_s), dtype=np.bool_)
        before = _STAND
        for start_s, name, begin_s, end_s in self._switches:
            begun = t_s >= start_s
            since = t_s[begun] - start_s - self._transition_s

            # A blend between two standing phases is not synthetic.
            blending = since < -_ROUNDING_S
            if name == _STAND:
                synthetic[begun] = blending & (before != _STAND)
            else:
                synthetic[begun] = blending | (since > end_s - begin_s + _ROUNDING_S)
            before = name
        return synthetic

    def observe(self, sensors: Sequence[Array], cameras: Array, truth: Array) -> Observation:
        """Return the observation at the given times (s) of each sensor, the cameras and the log."""
        orientations = [
            self._sensor(name, t) for name, t in zip(self.sensors, sensors, strict=True)
        ]
        markers = np.empty((len(cameras), 0, 3))
        if self._markers is not None:
            place, _ = self._place(cameras)
            recorded = self._markers.at(place).reshape(len(cameras), len(self._columns), 3)
            markers = recorded[:, self._columns]
        bones = {name: self._bone(name, cameras) for name in self._bones}
        return Observation(orientations, markers, bones, self._truth(truth))

    def _sensor(self, name: str, t_s: Array) -> Array:
        bias = self._recording.biases.get(name)
        still = self._tracks[name].at(_FIRST)[0] if bias is None else bias * [1, -1, -1, -1]
        return self._blend_with_standing(self._tracks[name], still, t_s)

    def _bone(self, name: str, t_s: Array) -> tuple[Rotation, Array]:
        turns, origins = self._bones[name]
        upright = np.array([1.0, 0.0, 0.0, 0.0])
        still = upright if self._recording.biases else turns.at(_FIRST)[0]
        place, share = self._place(t_s)
        standing = self._standing_origins[name]
        origin = share[:, None] * origins.at(place) + (1 - share[:, None]) * standing
        origin[self._synthetic(t_s)] = np.nan
        return from_wxyz(self._blend_with_standing(turns, still, t_s)), origin

    def _blend_with_standing(self, track: InterpolatedTrack, still: Array, t_s: Array) -> Array:
        """Blend a track with its value while standing, along the shortest arc."""
        place, share = self._place(t_s)
        moving = track.at(place)
        blending = (share < 1) & np.isfinite(moving[:, 0])
        if np.any(blending):
            rest = from_wxyz(still)
            arc = (rest.inv() * from_wxyz(moving[blending])).as_rotvec() * share[blending, None]
            moving[blending] = to_wxyz(rest * Rotation.from_rotvec(arc))
        return moving

    def _truth(self, t_s: Array) -> GroundTruth:
        bones = {name: self._bone(name, t_s) for name in self._bones}
        unknown = np.full((len(t_s), 3), np.nan)
        joints = {"hip": unknown, "knee": unknown, "ankle": unknown}
        joints |= {
            joint: bones[part][1]
            for joint, part in (("hip", "thigh"), ("knee", "shank"))
            if part in bones
        }

        turns = {name: turn for name, (turn, _) in bones.items()}
        if not {"thigh", "shank"} <= set(turns) or not len(t_s):
            return GroundTruth(turns, joints, unknown, unknown[:, 0])
        knee = (turns["thigh"].inv() * turns["shank"]).as_euler("XYZ") * [-1, 1, 1]
        return GroundTruth(turns, joints, knee, included_angle(turns["thigh"], turns["shank"]))
