"""Two legs with their pelvis: bones, markers and movements.

The left leg is the mirror image of the right leg. The angles of both legs have the same signs: a
positive angle moves both legs in the same clinical direction.

Invariant: a motion has two continuous derivatives.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from jointfit_simulators.body._limb import (
    ANKLE,
    HIP,
    KNEE,
    LEFT_ANKLE,
    LEFT_HIP,
    LEFT_KNEE,
    LEFT_LEG_ANGLES,
    LEG_ANGLES,
    PELVIS_TURN,
    LegGeometry,
    LegPose,
    joint_rotation,
    leg_pose,
)
from jointfit_simulators.body._limb_kind import Connection, LimbKind, MainJoint, RigChain
from jointfit_simulators.body._motion import (
    ankle_circles,
    hip_circles,
    knee_swings,
    sit_to_stand,
    squat,
    stand,
    walk,
)
from jointfit_simulators.body._placement import PLATE_MARKERS, marker_templates
from jointfit_simulators.body._posture import (
    HEADING,
    LIST,
    MovementStyle,
    column,
    deviation,
    in_turn,
    on_plate,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.arrays import Array
    from jointfit_simulators.body._motion import StyledMotion

_GEOMETRY = LegGeometry()
_MIRROR = np.array([-1.0, 1.0, 1.0])
"""Factors of a reflection about the sagittal plane."""
_LATER_S = 550.0
"""Delay of the left leg's variability, s. It is a multiple of the stride (1.1 s), and so long
that the variability of both legs is independent."""
_HALF_STRIDE_S = 0.55
_PARTS = ("thigh", "shank", "foot")
_CLUSTERS = {
    "pelvis": ("P1", "P2", "P3", "P4"),
    **{
        f"{side}_{part}": tuple(f"{side[0].upper()}{letter}{k}" for k in (1, 2, 3, 4))
        for side in ("right", "left")
        for part, letter in zip(_PARTS, "TCF", strict=True)
    },
}


def legs_pose(coordinates: Array) -> LegPose:
    """Return the bones for coordinates of shape (n, COORDINATES)."""
    right = leg_pose(_GEOMETRY, coordinates)
    pelvis, origin = right.orientations["pelvis"], right.origins["pelvis"]

    mirrored = np.array([1.0, -1.0, -1.0])  # adduction and rotation change sign
    thigh = pelvis * joint_rotation(1, mirrored * coordinates[:, LEFT_HIP])
    shank = thigh * joint_rotation(-1, mirrored * coordinates[:, LEFT_KNEE])
    foot = shank * joint_rotation(1, mirrored * coordinates[:, LEFT_ANKLE])
    hip = origin + pelvis.apply(_MIRROR * _GEOMETRY.hip_in_pelvis)
    knee = hip + thigh.apply([0.0, 0.0, -_GEOMETRY.thigh_m])
    ankle = knee + shank.apply([0.0, 0.0, -_GEOMETRY.shank_m])

    left = [f"left_{part}" for part in _PARTS]
    orientations = {"pelvis": pelvis} | {f"right_{p}": right.orientations[p] for p in _PARTS}
    origins = {"pelvis": origin} | {f"right_{p}": right.origins[p] for p in _PARTS}
    return LegPose(
        orientations | dict(zip(left, (thigh, shank, foot), strict=True)),
        origins | dict(zip(left, (hip, knee, ankle), strict=True)),
    )


def _together(motion: StyledMotion) -> StyledMotion:
    """Return a motion in which both legs move equally, each with its own variability."""

    def moved(style: MovementStyle, t: Array) -> Array:
        coordinates = motion(style, t)
        angles = coordinates[:, LEG_ANGLES]
        if motion is stand:
            own, other = style.sway.at(t), style.sway.at(t + _LATER_S)
        else:
            own, other = deviation(style, t), deviation(style, t + _LATER_S)
        coordinates[:, LEFT_LEG_ANGLES] = angles + other - own
        return coordinates

    return moved


def _in_alternation(style: MovementStyle, t: Array) -> Array:
    """Walk; the left leg follows with a delay of half a stride."""
    coordinates = walk(style, t)
    later = walk(style, t + _LATER_S + _HALF_STRIDE_S)
    coordinates[:, LEFT_LEG_ANGLES] = later[:, LEG_ANGLES]
    return coordinates


def _one_leg(motion: StyledMotion, side: str) -> StyledMotion:
    """Return a motion of one leg while the subject stands on the other leg."""

    def moved(style: MovementStyle, t: Array) -> Array:
        coordinates = motion(style, t)
        standing = 0.3 * deviation(style, t + _LATER_S)
        coordinates[:, LEFT_LEG_ANGLES] = standing
        if side == "left":
            coordinates[:, LEFT_LEG_ANGLES] = coordinates[:, LEG_ANGLES]
            coordinates[:, LEG_ANGLES] = standing
            for mirrored in (0, column(PELVIS_TURN, HEADING), column(PELVIS_TURN, LIST)):
                coordinates[:, mirrored] *= -1.0
        return coordinates

    return moved


def plate(style: MovementStyle, t: Array) -> Array:
    """Stand and rotate the plate with all sensors by hand, about every axis."""
    return on_plate(MOTIONS["stand"](style, t), t)


_ONE_LEG = {
    f"{side}_{motion.__name__}": _one_leg(motion, side)
    for motion in (hip_circles, knee_swings, ankle_circles)
    for side in ("right", "left")
}
MOTIONS: Mapping[str, StyledMotion] = {
    "stand": _together(stand),
    "walk": _in_alternation,
    "squat": _together(squat),
    "sit_to_stand": _together(sit_to_stand),
    **_ONE_LEG,
    "functional": partial(
        in_turn,
        (
            _in_alternation, _ONE_LEG["right_hip_circles"], _ONE_LEG["left_hip_circles"],
            _together(squat), _ONE_LEG["right_knee_swings"], _ONE_LEG["left_knee_swings"],
            _ONE_LEG["right_ankle_circles"], _ONE_LEG["left_ankle_circles"],
        ),
    ),
    "plate": plate,
}  # fmt: skip
"""Motions of both legs. A motion with a side in its name moves one leg."""


def _templates(random: np.random.Generator) -> dict[str, Array]:
    """Return marker positions in the frame of each part, m; the left side is mirrored."""
    right = marker_templates(random, _GEOMETRY)
    left = marker_templates(random, _GEOMETRY)  # with other placement errors
    found = {"pelvis": right["pelvis"]} | {f"right_{part}": right[part] for part in _PARTS}
    return found | {f"left_{part}": left[part] * _MIRROR for part in _PARTS}


_RIGHT_HIP = list(_GEOMETRY.hip_in_pelvis)
LEGS = LimbKind(
    name="legs",
    pose=legs_pose,
    joints={
        f"{side}_{joint}": f"{side}_{part}"
        for side in ("right", "left")
        for joint, part in zip(("hip", "knee", "ankle"), _PARTS, strict=True)
    },
    main=MainJoint("right_knee", KNEE, "right_thigh", "right_shank"),
    sensors={
        "S1": "pelvis", "S2": "pelvis", "S3": "right_thigh", "S4": "right_thigh",
        "S5": "right_shank", "S6": "right_shank", "S7": "left_thigh", "S8": "left_thigh",
        "S9": "left_shank", "S10": "left_shank",
    },
    clusters=_CLUSTERS | PLATE_MARKERS,
    templates=_templates,
    adjacent={
        "pelvis": (HIP, LEFT_HIP),
        "right_thigh": (HIP, KNEE), "right_shank": (KNEE, ANKLE), "right_foot": (ANKLE,),
        "left_thigh": (LEFT_HIP, LEFT_KNEE), "left_shank": (LEFT_KNEE, LEFT_ANKLE),
        "left_foot": (LEFT_ANKLE,),
    },
    motions=MOTIONS,
    reference=("walk", "squat"),
    facts={
        "lengths_m": {
            "pelvis": 2.0 * _GEOMETRY.hip_in_pelvis[0],
            **{
                f"{side}_{part}": length
                for side in ("right", "left")
                for part, length in (("thigh", _GEOMETRY.thigh_m), ("shank", _GEOMETRY.shank_m))
            },
        },
        "joint_centers_m": {
            "right_hip_in_pelvis": _RIGHT_HIP,
            "left_hip_in_pelvis": [-_RIGHT_HIP[0], *_RIGHT_HIP[1:]],
        },
    },
    chain=RigChain(
        joints=(),
        segments=("pelvis", "right_thigh", "right_shank", "left_thigh", "left_shank"),
        connections=tuple(
            Connection(f"{side}_{joint}", parent, f"{side}_{child}", begin)
            for side in ("right", "left")
            for joint, parent, child, begin in (
                ("hip", "pelvis", "thigh", side),
                ("knee", f"{side}_thigh", "shank", None),
                ("ankle", f"{side}_shank", "foot", None),
            )
        ),
    ),
)  # fmt: skip
