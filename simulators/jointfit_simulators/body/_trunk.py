"""The trunk (pelvis, thorax and head): bones, markers and movements.

The angles of a joint describe the upper part relative to the lower part: forward flexion, bending
to the right, and rotation to the left.

The *base world* is the world in which the movement of the subject is described, with z up.

Invariant: a motion has two continuous derivatives.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from jointfit_simulators.body._limb import (
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

LUMBAR, NECK = HIP, KNEE
"""Columns of the first and second joint of the limb."""
PELVIS_AT = (0.0, 0.0, 1.0)
"""Origin of the pelvis in the base world, m."""
LUMBAR_IN_PELVIS = (0.0, 0.0, 0.08)
"""Lumbar joint centre in pelvis coordinates (right, anterior, up), m."""
THORAX_M = 0.42
"""Height of the neck above the lumbar joint, m."""

_CLUSTERS = {
    "pelvis": ("P1", "P2", "P3", "P4"),
    "thorax": ("X1", "X2", "X3", "X4"),
    "head": ("E1", "E2", "E3", "E4"),
}
_MARKERS = {
    "pelvis": ((0.12, 0.08, 0.0), (-0.12, 0.08, 0.0), (0.05, -0.10, 0.02), (-0.05, -0.10, 0.02)),
    "thorax": ((0.0, 0.11, 0.36), (0.02, 0.12, 0.20), (0.06, -0.10, 0.38), (-0.06, -0.11, 0.22)),
    "head": ((0.08, 0.06, 0.16), (-0.08, 0.06, 0.15), (0.06, -0.09, 0.17), (-0.02, 0.03, 0.22)),
}  # fmt: skip
"""Nominal marker positions in the frame of each part, m. The origin of a frame is its lower joint.
"""


def trunk_pose(coordinates: Array) -> LegPose:
    """Return the bones for coordinates of shape (n, COORDINATES), with lower joints as origins."""
    pelvis = Rotation.from_euler("ZXY", coordinates[:, PELVIS_TURN])
    thorax = pelvis * joint_rotation(-1, coordinates[:, LUMBAR])
    head = thorax * joint_rotation(-1, coordinates[:, NECK])

    origin = coordinates[:, PELVIS_POSITION]
    lumbar = origin + pelvis.apply(np.array(LUMBAR_IN_PELVIS))
    neck = lumbar + thorax.apply([0.0, 0.0, THORAX_M])
    return LegPose(
        {"pelvis": pelvis, "thorax": thorax, "head": head},
        {"pelvis": origin, "thorax": lumbar, "head": neck},
    )


def stand(style: MovementStyle, t: Array) -> Array:
    """Stand upright with a sway of tenths of a degree."""
    coordinates = rest(t, PELVIS_AT)
    coordinates[:, LEG_ANGLES] += style.sway.at(t)
    return coordinates


def _moving(style: MovementStyle, t: Array) -> Array:
    coordinates = rest(t, PELVIS_AT)
    coordinates[:, LEG_ANGLES] += style.variability.at(t)
    coordinates[:, column(PELVIS_TURN, HEADING)] = np.radians(4) * np.sin(2 * np.pi * 0.23 * t)
    return coordinates


def bend(style: MovementStyle, t: Array) -> Array:
    """Bend forward to 65 degrees of lumbar flexion and straighten up, every 3 s."""
    coordinates = _moving(style, t)
    depth = (1 - np.cos(2 * np.pi * t / 3.0)) / 2
    coordinates[:, column(LUMBAR, FLEXION)] += np.radians(65) * depth
    coordinates[:, column(PELVIS_TURN, TILT)] = np.radians(-25) * depth
    coordinates[:, column(NECK, FLEXION)] += np.radians(-30) * depth
    return coordinates


def side_bend(style: MovementStyle, t: Array) -> Array:
    """Bend by 25 degrees to either side."""
    coordinates = _moving(style, t)
    swing = np.sin(2 * np.pi * 0.3 * t)
    coordinates[:, column(LUMBAR, ADDUCTION)] += np.radians(25) * swing
    coordinates[:, column(LUMBAR, FLEXION)] += np.radians(4) * swing**2
    coordinates[:, column(NECK, ADDUCTION)] += np.radians(-12) * swing
    return coordinates


def twist(style: MovementStyle, t: Array) -> Array:
    """Turn the thorax by 35 degrees to either side with the trunk slightly bent."""
    coordinates = _moving(style, t)
    coordinates[:, column(LUMBAR, ROTATION)] += np.radians(35) * np.sin(2 * np.pi * 0.35 * t)
    coordinates[:, column(LUMBAR, FLEXION)] += np.radians(10 + 8 * np.sin(2 * np.pi * 0.21 * t))
    coordinates[:, column(NECK, ROTATION)] += np.radians(20) * np.sin(2 * np.pi * 0.27 * t)
    return coordinates


def nod(style: MovementStyle, t: Array) -> Array:
    """Bend the head forward and back, with small movements of the trunk."""
    coordinates = _moving(style, t)
    coordinates[:, column(NECK, FLEXION)] += np.radians(40) * np.sin(2 * np.pi * 0.45 * t)
    coordinates[:, column(NECK, ADDUCTION)] += np.radians(12) * np.sin(2 * np.pi * 0.31 * t)
    coordinates[:, column(LUMBAR, FLEXION)] += np.radians(10) * np.sin(2 * np.pi * 0.27 * t)
    return coordinates


def plate(style: MovementStyle, t: Array) -> Array:
    """Stand and rotate the plate with all sensors by hand, about every axis."""
    return on_plate(stand(style, t), t)


functional = partial(in_turn, (bend, nod, twist, bend, side_bend))
"""Repeat bending, nodding, turning, bending and bending sideways, 4 s each."""

TRUNK = LimbKind(
    name="trunk",
    pose=trunk_pose,
    joints={"lumbar": "thorax", "neck": "head"},
    main=MainJoint("lumbar", LUMBAR, "pelvis", "thorax"),
    sensors={"S1": "thorax", "S2": "thorax", "S3": "pelvis", "S4": "pelvis"},
    clusters=_CLUSTERS | PLATE_MARKERS,
    templates=partial(place_markers, _MARKERS),
    adjacent={"pelvis": (LUMBAR,), "thorax": (LUMBAR, NECK), "head": (NECK,)},
    motions={
        "stand": stand, "bend": bend, "side_bend": side_bend, "twist": twist, "nod": nod,
        "functional": functional, "plate": plate,
    },
    reference=("bend", "twist"),
    facts={
        "lengths_m": {"thorax": THORAX_M},
        "joint_centers_m": {
            "lumbar_in_pelvis": list(LUMBAR_IN_PELVIS),
            "neck_in_thorax": [0.0, 0.0, THORAX_M],
        },
    },
    chain=RigChain(
        joints=("neck", "lumbar", "hips"),
        segments=("thorax", "pelvis"),
        proximal="head",
        lengths_m={"pelvis": 0.1},
    ),
)  # fmt: skip
