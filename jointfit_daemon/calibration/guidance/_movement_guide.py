"""Leads a functional movement: what is known by now, what is missing, and when it is enough.

Law: three demands, each with its remedy in words. Every joint that carries markers on both sides
has its center to the target (noise part); every joint between two sensors has bent far and often
enough for the regression that combines them; and the least time is over. Whoever leaves one open
gets the rest of the time, and its name.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import degrees, isfinite
from typing import TYPE_CHECKING

from jointfit_daemon.calibration._errors import CalibrationRefused
from jointfit_daemon.calibration.anatomy import marked_parts, static_cluster
from jointfit_daemon.calibration.guidance._live_joint_centers import LiveCenter, LiveCenters
from jointfit_daemon.calibration.guidance._movement_instructions import words_for
from jointfit_daemon.calibration.guidance._movement_progress import MovementProgress

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.calibration._trial import (
        CalibrationSettings,
        CalibrationTrial,
        OpticalTrack,
    )
    from jointfit_daemon.calibration.guidance._live_clusters import PartFigures
    from jointfit_daemon.limb_model import Cluster
    from jointfit_daemon.model import Chain, MocapFrame, Quaternion

MIN_BENDS = 12
"""Steps and squats that a joint between two sensors must have done: half a minute of both."""
MIN_SEEN = 0.5
"""The fit refuses a body part that was seen in a smaller share of the frames."""
MAX_MISFITS = 0.1
PATIENCE_S = 2.0
"""Before this nothing is said of markers: a moment behind an arm is no fault."""


@dataclass(frozen=True, slots=True)
class MovementLook:
    """A functional movement as it stands."""

    joints: Mapping[str, Mapping[str, object]]
    """Figures of every joint, as published: unknown is None, never infinite."""
    parts: Mapping[str, Mapping[str, object]]
    """How well the cameras see every body part."""
    missing: tuple[str, ...]
    """What keeps the phase from ending, each with its remedy; most urgent first."""

    @property
    def ready(self) -> bool:
        """Whether nothing is missing."""
        return not self.missing


class MovementGuide:
    """Watches one functional phase.

    Parameters
    ----------
    chain : Chain
        What is calibrated.
    settings : CalibrationSettings
        Target and markers.
    standing : CalibrationTrial or None
        The static pose; without cameras in it only the sensors tell.
    """

    def __init__(
        self, chain: Chain, settings: CalibrationSettings, standing: CalibrationTrial | None
    ) -> None:
        self._chain, self._target = chain, settings.center_target_m
        optical = None if standing is None else standing.optical
        clusters, self._faults = _clusters(chain, settings, optical)
        self._centers = LiveCenters(chain, clusters)
        self._movement = MovementProgress(chain, _last_said(standing))

    def add_mocap(self, frame: MocapFrame) -> None:
        """Take one camera frame."""
        self._centers.feed(frame)

    def look(self, latest: Mapping[str, Quaternion], elapsed_s: float) -> MovementLook:
        """Return what is known by now.

        Parameters
        ----------
        latest : mapping of str to Quaternion
            Newest orientation of each sensor that is alive.
        elapsed_s : float
            Since the phase began, s.
        """
        self._movement.look(latest)
        centers = self._centers.look()
        figures = self._centers.parts.figures()
        guessed = self._movement.predicted_center_errors(elapsed_s)
        arcs, bends = self._movement.arcs(), self._movement.bends()
        missing = list(self._faults)
        if elapsed_s > PATIENCE_S:
            missing += [text for name, part in figures.items() if (text := _fault(name, part))]
        joints: dict[str, Mapping[str, object]] = {}
        inner = self._chain.joints[1:-1]
        for joint in self._chain.joints:
            told: dict[str, object] = {}
            wants: str | None = None
            if (center := centers.get(joint)) is not None:
                wants = _wanted(center, self._target)
                told = _figures(center, wants)
            if center is None or center.center is None:
                told = self._guess(joint, guessed.get(joint), arcs.get(joint)) | {"unseen": wants}
            if joint in inner:
                told["bends"] = bends.get(joint, 0)
                wants = wants or _too_little(joint, arcs.get(joint, 0.0), bends.get(joint, 0))
            joints[joint] = told | {"met": wants is None}
            if wants is not None:
                missing.append(f"{joint}: {wants}")
        parts = {name: {"seen_pct": round(100 * part.seen, 1)} for name, part in figures.items()}
        return MovementLook(joints, parts, tuple(missing))

    def _guess(self, joint: str, error: float | None, arc: float | None) -> dict[str, object]:
        """Return what is known of a joint whose markers do not show it."""
        i = self._chain.joints.index(joint)
        beside = [k for k in (i - 1, i) if 0 <= k < len(self._chain.segments)]
        lengths = self._chain.lengths
        if 0 < i < len(self._chain.segments):
            source = "sensors"
        elif any(k < len(lengths) and lengths[k] is not None for k in beside):
            source = "configured"
        else:
            source = "unknown"
        return {
            "source": source,
            "predicted_error_mm": _mm(error),
            "noise_error_mm": None,
            "arc_deg": None if arc is None else round(degrees(arc), 1),
            "conditioning": None,
            "frames": 0,
        }


def _last_said(standing: CalibrationTrial | None) -> dict[str, Quaternion]:
    """Return the last orientation of each sensor that a still trial holds."""
    said = {} if standing is None else standing.sensors
    last = {s: track.q_world_sensor[-1].tolist() for s, track in said.items() if len(track.t_ns)}
    return {sensor: (w, x, y, z) for sensor, (w, x, y, z) in last.items()}


def _clusters(
    chain: Chain, settings: CalibrationSettings, standing: OpticalTrack | None
) -> tuple[dict[str, Cluster], list[str]]:
    """Return the body parts as they stood, and why others are not among them."""
    clusters: dict[str, Cluster] = {}
    faults: list[str] = []
    if standing is None:
        return {}, []
    for name in marked_parts(settings, chain):
        try:
            clusters[name] = static_cluster(standing, name, settings)
        except CalibrationRefused as refusal:
            faults += refusal.reasons
    return clusters, faults


def _fault(name: str, part: PartFigures) -> str | None:
    """Return what is wrong with the markers of a body part, and what to do."""
    if part.absent:
        return f"{name}: the cameras send no {', '.join(part.absent)}: check the names"
    if part.misfits > MAX_MISFITS:
        return (
            f"{name}: {part.suspect} is not where it was in the static pose: check that it sits "
            "firm and that no names are swapped, or repeat the static pose"
        )
    if part.seen < MIN_SEEN:
        return (
            f"{name}: its markers are seen together in {100 * part.seen:.0f} % of the time: turn "
            "so that the cameras see three of them, or add markers"
        )
    return None


def _wanted(one: LiveCenter, target: float) -> str | None:
    """Return the movement that a joint center still needs; None if it needs none."""
    words = words_for(one.joint)
    if one.frames == 0:
        return "its markers were not seen yet: move so that the cameras see both sides of it"
    if one.center is None or one.unseen > 1:
        return f"not moved far enough yet: {words.bend}"
    if one.unseen == 1 and not words.hinge:
        return f"no circumduction, it moved about one axis only: {words.sideways}"
    noise = _noise(one)
    if noise <= target and one.refused is None:
        return None
    if one.refused is not None and noise <= target:
        return one.refused
    more = words.bend if words.hinge else f"{words.bend}, and {words.sideways}"
    return f"known to {1e3 * noise:.1f} mm, {1e3 * target:g} mm are wanted: {more}"


def _noise(one: LiveCenter) -> float:
    return one.noise_across if words_for(one.joint).hinge else one.noise


def _figures(one: LiveCenter, wants: str | None) -> dict[str, object]:
    return {
        "source": "markers" if one.unseen == 0 else "markers, static pose",
        "predicted_error_mm": _mm(one.total),
        "noise_error_mm": _mm(_noise(one)),
        "arc_deg": round(degrees(one.arc), 1),
        "conditioning": round(one.conditioning, 1),
        "frames": one.frames,
        "unseen": wants,
    }


def _too_little(joint: str, arc: float, bends: int) -> str | None:
    """Return what the regression of the sensors still needs of a joint."""
    words = words_for(joint)
    if arc < words.arc:
        return f"{degrees(arc):.0f}° of {degrees(words.arc):.0f}° so far: {words.bend}"
    if bends < MIN_BENDS:
        return f"bent {bends} of {MIN_BENDS} times: walk, {words.bend}"
    return None


def _mm(length: float | None) -> float | None:
    return None if length is None or not isfinite(length) else round(1e3 * length, 2)


def first_of(missing: Sequence[str]) -> str:
    """Return what is most urgent, and how much more there is."""
    rest = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
    return f"{missing[0]}{rest}" if missing else ""
