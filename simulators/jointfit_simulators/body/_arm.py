"""A right arm on the thorax: bones, markers and movements.

The angles of the shoulder describe the tilt and the torsion of the upper arm. The first two columns
are the rotation vector of the tilt, positive forward and towards the midline. The third column is
the torsion, positive for internal rotation. These angles have no singularity below 180 degrees of
elevation. Elbow and wrist have the angles of the leg: flexion forward, adduction, and internal
rotation, which is pronation.

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
    LEG_ANGLES,
    PELVIS_POSITION,
    PELVIS_TURN,
    LegPose,
    joint_rotation,
)
from jointfit_simulators.body._limb_kind import LimbKind, MainJoint, RigChain
from jointfit_simulators.body._orientation import Rotation
from jointfit_simulators.body._placement import PLATE_MARKERS, place_markers
from jointfit_simulators.body._posture import (
    ADDUCTION,
    FLEXION,
    HEADING,
    LIST,
    ROTATION,
    TILT,
    MovementStyle,
    column,
    in_turn,
    on_plate,
    rest,
)

if TYPE_CHECKING:
    from jointfit_daemon.arrays import Array

SHOULDER, ELBOW, WRIST = HIP, KNEE, ANKLE
"""Columns of the first, second and third joint of the limb."""
UPPER_ARM_M, FOREARM_M = 0.30, 0.26
SHOULDER_IN_THORAX = (0.17, 0.0, -0.05)
"""Shoulder joint centre in thorax coordinates (right, anterior, up), m."""
THORAX_AT = (0.0, 0.0, 1.45)
"""Origin of the thorax, at the height of the suprasternal notch, in the base world (see
`LimbKind`), m."""

_CLUSTERS = {
    "thorax": ("X1", "X2", "X3", "X4"),
    "upper_arm": ("U1", "U2", "U3", "U4"),
    "forearm": ("A1", "A2", "A3", "A4"),
    "hand": ("H1", "H2", "H3", "H4"),
}
_MARKERS = {
    "thorax": (
        (0.0, 0.10, -0.04), (0.0, 0.12, -0.20), (0.04, -0.10, 0.02), (-0.06, -0.11, -0.15),
    ),
    "upper_arm": (
        (0.05, 0.01, -0.06), (0.02, 0.05, -0.11), (0.05, -0.02, -0.19), (0.01, 0.05, -0.25),
    ),
    "forearm": (
        (0.04, 0.01, -0.04), (0.01, 0.04, -0.10), (0.035, -0.02, -0.16), (0.01, 0.03, -0.23),
    ),
    "hand": (
        (0.03, 0.01, -0.02), (-0.03, 0.01, -0.03), (0.03, 0.01, -0.08), (-0.02, 0.02, -0.09),
    ),
}  # fmt: skip
"""Nominal marker positions in the frame of each part, m."""


def arm_pose(coordinates: Array) -> LegPose:
    """Return the bones for coordinates of shape (n, COORDINATES)."""
    thorax = Rotation.from_euler("ZXY", coordinates[:, PELVIS_TURN])
    tilt, torsion = coordinates[:, SHOULDER] * [1, 1, 0], coordinates[:, SHOULDER] * [0, 0, 1]
    upper_arm = thorax * Rotation.from_rotvec(tilt) * Rotation.from_rotvec(torsion)
    forearm = upper_arm * joint_rotation(1, coordinates[:, ELBOW])
    hand = forearm * joint_rotation(1, coordinates[:, WRIST])

    origin = coordinates[:, PELVIS_POSITION]
    shoulder = origin + thorax.apply(np.array(SHOULDER_IN_THORAX))
    elbow = shoulder + upper_arm.apply([0.0, 0.0, -UPPER_ARM_M])
    wrist = elbow + forearm.apply([0.0, 0.0, -FOREARM_M])
    return LegPose(
        {"thorax": thorax, "upper_arm": upper_arm, "forearm": forearm, "hand": hand},
        {"thorax": origin, "upper_arm": shoulder, "forearm": elbow, "hand": wrist},
    )


def stand(style: MovementStyle, t: Array) -> Array:
    """Stand with hanging arms, palms forward, and a sway of tenths of a degree."""
    coordinates = rest(t, THORAX_AT)
    coordinates[:, LEG_ANGLES] += style.sway.at(t)
    return coordinates


def _moving(style: MovementStyle, t: Array) -> Array:
    """Return the rest position plus the sway of the trunk and the subject's variability."""
    coordinates = rest(t, THORAX_AT)
    coordinates[:, LEG_ANGLES] += style.variability.at(t)
    coordinates[:, column(PELVIS_TURN, HEADING)] = np.radians(3) * np.sin(2 * np.pi * 0.23 * t)
    coordinates[:, column(PELVIS_TURN, TILT)] = np.radians(2) * np.sin(2 * np.pi * 0.31 * t)
    coordinates[:, column(PELVIS_TURN, LIST)] = np.radians(2) * np.sin(2 * np.pi * 0.17 * t)
    return coordinates


def _wave(t: Array, hz: float, phase: float = 0.0) -> Array:
    """Return a wave between 0 and 1, shape (n,), which begins at 0 if `phase` is 0."""
    wave: Array = (1 - np.cos(2 * np.pi * hz * t + phase)) / 2
    return wave


def arm_swings(style: MovementStyle, t: Array) -> Array:
    """Swing the arm forward to 90 degrees and back to 25 degrees."""
    coordinates = _moving(style, t)
    coordinates[:, column(SHOULDER, FLEXION)] += np.radians(-25 + 115 * _wave(t, 0.4, 0.9))
    coordinates[:, column(SHOULDER, ADDUCTION)] += np.radians(-6) * _wave(t, 0.23)
    coordinates[:, column(ELBOW, FLEXION)] += np.radians(8 + 25 * _wave(t, 0.4, 0.4))
    return coordinates


def abduction(style: MovementStyle, t: Array) -> Array:
    """Raise the arm sideways to 120 degrees, with the accompanying external rotation."""
    coordinates = _moving(style, t)
    raised = _wave(t, 0.25)
    coordinates[:, column(SHOULDER, ADDUCTION)] += np.radians(-120) * raised
    coordinates[:, column(SHOULDER, FLEXION)] += np.radians(12) * raised
    coordinates[:, column(SHOULDER, ROTATION)] += np.radians(-30) * raised
    coordinates[:, column(ELBOW, FLEXION)] += np.radians(10)
    return coordinates


def elbow_flexion(style: MovementStyle, t: Array) -> Array:
    """Bend the elbow to 130 degrees and turn the palm."""
    coordinates = _moving(style, t)
    bend = _wave(t, 0.45)
    coordinates[:, column(ELBOW, FLEXION)] += np.radians(5 + 125 * bend)
    coordinates[:, column(ELBOW, ADDUCTION)] += np.radians(-8) * np.cos(np.radians(125) * bend / 2)
    coordinates[:, column(ELBOW, ADDUCTION)] += np.radians(
        8
    )  # the carrying angle is 0 in the static pose
    coordinates[:, column(ELBOW, ROTATION)] += np.radians(55) * np.sin(2 * np.pi * 0.19 * t) * bend
    coordinates[:, column(SHOULDER, FLEXION)] += np.radians(20) * _wave(t, 0.21)
    coordinates[:, column(WRIST, FLEXION)] += np.radians(15) * np.sin(2 * np.pi * 0.33 * t)
    return coordinates


def wrist_circles(style: MovementStyle, t: Array) -> Array:
    """Circle the hand with a bent elbow."""
    coordinates = _moving(style, t)
    phase = 2 * np.pi * 0.7 * t
    coordinates[:, column(SHOULDER, FLEXION)] += np.radians(25)
    coordinates[:, column(ELBOW, FLEXION)] += np.radians(60 + 20 * np.sin(0.9 * t))
    coordinates[:, column(ELBOW, ROTATION)] += np.radians(25) * np.sin(0.31 * phase)
    coordinates[:, column(WRIST, FLEXION)] += np.radians(40) * np.sin(phase)
    coordinates[:, column(WRIST, ADDUCTION)] += np.radians(15) * np.cos(phase)
    return coordinates


def reach(style: MovementStyle, t: Array) -> Array:
    """Reach forward, sideways and up to the mouth with shoulder and elbow together."""
    coordinates = _moving(style, t)
    out = _wave(t, 0.35)
    side = np.sin(2 * np.pi * 0.11 * t)
    coordinates[:, column(SHOULDER, FLEXION)] += np.radians(75) * out
    coordinates[:, column(SHOULDER, ADDUCTION)] += np.radians(-35) * side * out
    coordinates[:, column(SHOULDER, ROTATION)] += np.radians(20) * side * out
    coordinates[:, column(ELBOW, FLEXION)] += np.radians(15 + 90 * _wave(t, 0.35, 1.8))
    coordinates[:, column(ELBOW, ROTATION)] += np.radians(40) * np.sin(2 * np.pi * 0.17 * t)
    coordinates[:, column(WRIST, FLEXION)] += np.radians(20) * np.sin(2 * np.pi * 0.35 * t)
    return coordinates


def plate(style: MovementStyle, t: Array) -> Array:
    """Stand and rotate the plate with all sensors by hand, about every axis."""
    return on_plate(stand(style, t), t)


def turn(style: MovementStyle, t: Array) -> Array:
    """Reach while the body turns by 90 degrees to either side, with a period of 16 s."""
    coordinates = reach(style, t)
    coordinates[:, column(PELVIS_TURN, HEADING)] += np.radians(90) * np.sin(2 * np.pi * t / 16.0)
    return coordinates


functional = partial(in_turn, (arm_swings, elbow_flexion, wrist_circles, abduction, reach))
"""Repeat arm swings, elbow flexion, wrist circles, abduction and reaching, 4 s each."""

ARM = LimbKind(
    name="arm",
    pose=arm_pose,
    joints={"shoulder": "upper_arm", "elbow": "forearm", "wrist": "hand"},
    main=MainJoint("elbow", ELBOW, "upper_arm", "forearm"),
    sensors={
        "S1": "thorax", "S2": "upper_arm", "S3": "upper_arm", "S4": "forearm", "S5": "forearm",
        "S6": "hand",
    },
    clusters=_CLUSTERS | PLATE_MARKERS,
    templates=partial(place_markers, _MARKERS),
    adjacent={
        "thorax": (SHOULDER,), "upper_arm": (SHOULDER, ELBOW), "forearm": (ELBOW, WRIST),
        "hand": (WRIST,),
    },
    motions={
        "stand": stand, "arm_swings": arm_swings, "abduction": abduction,
        "elbow_flexion": elbow_flexion, "wrist_circles": wrist_circles, "reach": reach,
        "functional": functional, "plate": plate, "turn": turn,
    },
    reference=("reach", "elbow_flexion"),
    facts={
        "lengths_m": {"upper_arm": UPPER_ARM_M, "forearm": FOREARM_M},
        "joint_centers_m": {
            "shoulder_in_thorax": list(SHOULDER_IN_THORAX),
            "elbow_in_upper_arm": [0.0, 0.0, -UPPER_ARM_M],
            "wrist_in_forearm": [0.0, 0.0, -FOREARM_M],
        },
    },
    chain=RigChain(
        joints=("acromion", "shoulder", "elbow", "wrist", "knuckles"),
        segments=("thorax", "upper_arm", "forearm", "hand"),
        lengths_m={"thorax": 0.05, "hand": 0.09},
    ),
)  # fmt: skip
