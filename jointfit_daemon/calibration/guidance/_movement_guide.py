"""Guidance of a functional movement: current accuracy, missing movement, and completion.

The movement is complete if three conditions hold:

1. The random error of the center of every joint with markers on both sides is below the target.
2. Every joint with sensors on both segments has flexed far and often enough to train the
soft-tissue models.
3. The shortest duration has passed.

The guide checks the first two conditions. For each condition that is not met, a message names the
missing movement. The recording of the phase checks the third condition. When the longest duration
has passed, the phase ends in any case, and the messages are reported.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, degrees, isfinite
from typing import TYPE_CHECKING

from jointfit_daemon.calibration._errors import CalibrationError
from jointfit_daemon.calibration._trial import ONE_AXIS
from jointfit_daemon.calibration.anatomy import marked_parts, static_cluster
from jointfit_daemon.calibration.guidance._live_joint_centers import (
    LiveJointCenter,
    LiveJointCenters,
)
from jointfit_daemon.calibration.guidance._live_labels import LiveLabels
from jointfit_daemon.calibration.guidance._movement_instructions import (
    JointInstructions,
    instructions_for,
)
from jointfit_daemon.calibration.guidance._movement_progress import MovementProgress
from jointfit_daemon.kinematics.rotation_scalar import as_quaternion
from jointfit_daemon.limb_model import (
    configured_length,
    distal_joints,
    inner_joints,
    proximal_segment,
)

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.calibration._trial import (
        CalibrationSettings,
        CalibrationTrial,
        OpticalTrack,
    )
    from jointfit_daemon.calibration.guidance._live_clusters import ClusterVisibility
    from jointfit_daemon.limb_model import MarkerCluster
    from jointfit_daemon.model import Chain, MocapFrame, Quaternion

MIN_BENDS = 12
"""Smallest number of flexions of a joint with sensors on both segments. Half a minute of steps and
squats contains this number.
"""
MIN_SEEN = 0.5
"""Smallest fraction of the frames in which a body part is visible. With a smaller fraction the fit
after the movement would be rejected.
"""
MAX_MISFITS = 0.1
"""Fraction of frames with displaced markers above which the operator is informed."""
PATIENCE_S = 2.0
"""Time before the first message about markers, s, because a short occlusion is not a fault."""


@dataclass(frozen=True, slots=True)
class MovementStatus:
    """Current state of a functional movement."""

    joints: Mapping[str, Mapping[str, object]]
    """Published values of every joint. An unknown value is None, never infinite."""
    parts: Mapping[str, Mapping[str, object]]
    """Visibility of every body part."""
    missing: tuple[str, ...]
    """Conditions that do not hold, with their remedies, most urgent first."""

    @property
    def ready(self) -> bool:
        """Whether all conditions that the guide checks hold."""
        return not self.missing


class MovementGuide:
    """Guides one functional phase.

    Parameters
    ----------
    chain : Chain
        The limb.
    settings : CalibrationSettings
        Target accuracy and markers.
    standing : CalibrationTrial or None
        Trial of the static pose. Without a trial or without camera data, only the sensors are
        evaluated.
    """

    def __init__(
        self, chain: Chain, settings: CalibrationSettings, standing: CalibrationTrial | None
    ) -> None:
        self._chain, self._target = chain, settings.center_target_m
        optical = None if standing is None else standing.optical
        self._one_axis = {j for j in chain.joints if settings.center_method_of(j) in ONE_AXIS}
        clusters, self._faults = _clusters(chain, settings, optical)
        self._centers = LiveJointCenters(chain, clusters)
        self._labels = LiveLabels(clusters)

        # The last orientation of each sensor in the static pose defines zero flexion.
        tracks = {} if standing is None else standing.sensors
        zeros = {
            sensor: as_quaternion(track.q_world_sensor[-1].tolist())
            for sensor, track in tracks.items()
            if len(track.t_ns)
        }
        self._movement = MovementProgress(chain, zeros)

    def add_mocap(self, frame: MocapFrame) -> None:
        """Process one camera frame."""
        self._centers.feed(frame)
        self._labels.feed(frame)

    def update(self, latest: Mapping[str, Quaternion], elapsed_s: float) -> MovementStatus:
        """Return the current state.

        Parameters
        ----------
        latest : mapping of str to Quaternion
            Newest orientation of each available sensor.
        elapsed_s : float
            Time since the start of the phase, s.
        """
        self._movement.update(latest)
        centers = self._centers.estimate_centers()
        figures = self._centers.parts.visibility()
        guessed = self._movement.predicted_center_errors(elapsed_s)
        arcs, bends = self._movement.arcs(), self._movement.bends()

        # Conditions on the body parts are checked after a short delay.
        missing = list(self._faults)
        if elapsed_s > PATIENCE_S:
            exchanges = self._labels.exchanges()
            missing += [f"{e.text}; correct the labels and repeat the phase" for e in exchanges]
            explained = {part for exchange in exchanges for part in exchange.parts}
            others = {name: part for name, part in figures.items() if name not in explained}
            missing += [text for name, part in others.items() if (text := _fault(name, part))]

        # Conditions on each joint: first the center from markers, then flexion measured by sensors.
        joints: dict[str, Mapping[str, object]] = {}
        inner = {joint.name for joint in inner_joints(self._chain)}
        for joint in self._chain.joints:
            figures_of_joint: dict[str, object] = {}
            lacking: str | None = None
            if (center := centers.get(joint)) is not None:
                words = instructions_for(joint)
                if joint in self._one_axis:
                    words = words._replace(hinge=True)
                lacking = _missing_movement(center, words, self._target)
                figures_of_joint = _figures(center, words, lacking)
            if center is None or center.center is None:
                figures_of_joint = self._figures_without_center(
                    joint, guessed.get(joint), arcs.get(joint)
                ) | {"unseen": lacking}
            if joint in inner:
                figures_of_joint["bends"] = bends.get(joint, 0)
                lacking = lacking or _too_little(joint, arcs.get(joint, 0.0), bends.get(joint, 0))
            joints[joint] = figures_of_joint | {"met": lacking is None}
            if lacking is not None:
                missing.append(f"{joint}: {lacking}")

        parts = {name: {"seen_pct": round(100 * part.seen, 1)} for name, part in figures.items()}
        return MovementStatus(joints, parts, tuple(missing))

    def _figures_without_center(
        self, joint: str, error: float | None, arc: float | None
    ) -> dict[str, object]:
        """Return the published values of a joint without a center from markers."""
        i = self._chain.joints.index(joint)
        count = len(self._chain.segments)
        beside = [
            configured_length(self._chain, k)
            for k in (proximal_segment(self._chain, i), i)
            if k is not None and k < count
        ]
        source = "unknown" if beside == [None] * len(beside) else "configured"
        if 0 < i < count:
            source = "sensors"
        elif i == 0 and len(distal_joints(self._chain, i)) > 1:
            source = "midpoint"

        return {
            "source": source,
            "predicted_error_mm": _mm(error),
            "noise_error_mm": None,
            "arc_deg": None if arc is None else round(degrees(arc), 1),
            "conditioning": None,
            "frames": 0,
        }


def _clusters(
    chain: Chain, settings: CalibrationSettings, standing: OpticalTrack | None
) -> tuple[dict[str, MarkerCluster], list[str]]:
    """Return the body parts in the static pose, and the reasons why body parts are missing."""
    clusters: dict[str, MarkerCluster] = {}
    faults: list[str] = []
    if standing is None:
        return {}, []
    for name in marked_parts(settings, chain):
        try:
            clusters[name] = static_cluster(standing, name, settings)
        except CalibrationError as refusal:
            faults += refusal.reasons
    return clusters, faults


def _fault(name: str, part: ClusterVisibility) -> str | None:
    """Return the problem with the markers of a body part and its remedy; None if there is none."""
    if part.absent:
        return f"{name}: the stream of the cameras has no {', '.join(part.absent)}: check the names"
    if part.misfits > MAX_MISFITS:
        return (
            f"{name}: {part.suspect} does not move with the other markers as in the static pose: "
            f"check that it is fixed on {name} and that no names are swapped, then repeat the "
            "static pose"
        )
    if part.seen < MIN_SEEN:
        return (
            f"{name}: three markers are visible in {100 * part.seen:.0f} % of the frames: turn "
            "toward the cameras, or add markers"
        )
    return None


def _missing_movement(one: LiveJointCenter, words: JointInstructions, target: float) -> str | None:
    """Return the movement that a joint center still needs, or why the center is refused.

    The result is None if the center is accepted and its random error is at most `target`, m.
    """
    if one.frames == 0:
        return "no visible markers yet: turn both sides of the joint toward the cameras"
    if one.center is None or one.unseen > 1:
        return f"movement too small: {words.bend}"
    if one.unseen == 1 and not words.hinge:
        return f"no circumduction, movement about one axis only: {words.sideways}"

    noise = _noise(one, words)
    if noise <= target:
        return one.refused
    more = words.bend if words.hinge else f"{words.bend}, and {words.sideways}"
    shown_mm = ceil(1e4 * noise) / 10.0  # rounded up, so that an unmet target is never shown as met
    return f"random error {shown_mm:.1f} mm, target {1e3 * target:g} mm: {more}"


def _noise(one: LiveJointCenter, words: JointInstructions) -> float:
    return one.noise_across if words.hinge else one.noise


def _figures(
    one: LiveJointCenter, words: JointInstructions, lacking: str | None
) -> dict[str, object]:
    return {
        "source": "markers" if one.unseen == 0 else "markers, static pose",
        "predicted_error_mm": _mm(one.total),
        "noise_error_mm": _mm(_noise(one, words)),
        "arc_deg": round(degrees(one.arc), 1),
        "conditioning": round(one.conditioning, 1),
        "frames": one.frames,
        "unseen": lacking,
    }


def _too_little(joint: str, arc: float, bends: int) -> str | None:
    """Return the flexion that the soft-tissue models still need; None if none is missing."""
    words = instructions_for(joint)
    if arc < words.arc:
        return f"{degrees(arc):.0f}° of {degrees(words.arc):.0f}° so far: {words.bend}"
    if bends < MIN_BENDS:
        return f"{bends} of {MIN_BENDS} flexions so far: walk, {words.bend}"
    return None


def _mm(length: float | None) -> float | None:
    return None if length is None or not isfinite(length) else round(1e3 * length, 2)


def most_urgent(missing: Sequence[str]) -> str:
    """Return the most urgent condition and the number of other conditions."""
    rest = f" (and {len(missing) - 1} more)" if len(missing) > 1 else ""
    return f"{missing[0]}{rest}" if missing else ""
