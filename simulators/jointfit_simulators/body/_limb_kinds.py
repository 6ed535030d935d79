"""The limbs of the simulator, by name: leg, legs, arm and trunk."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from jointfit_simulators.body._arm import ARM
from jointfit_simulators.body._legs import LEGS
from jointfit_simulators.body._limb import KNEE, LegGeometry, leg_pose
from jointfit_simulators.body._limb_kind import LimbKind, MainJoint, RigChain
from jointfit_simulators.body._motion import MOTIONS
from jointfit_simulators.body._placement import CLUSTERS, marker_templates
from jointfit_simulators.body._soft_tissue import ADJACENT
from jointfit_simulators.body._trunk import TRUNK

if TYPE_CHECKING:
    from collections.abc import Mapping

SENSORS = {"S1": "thigh", "S2": "thigh", "S3": "shank", "S4": "shank"}
"""Segment of each default sensor of the leg, by sensor id."""
LEG_CHAIN = RigChain(("hip", "knee", "ankle"), ("thigh", "shank"), "pelvis", "foot")
"""Description of the leg in rig.toml."""


def leg(geometry: LegGeometry) -> LimbKind:
    """Return a right leg with the given bone lengths."""
    return LimbKind(
        name="leg",
        pose=partial(leg_pose, geometry),
        joints={"hip": "thigh", "knee": "shank", "ankle": "foot"},
        main=MainJoint("knee", KNEE, "thigh", "shank"),
        sensors=SENSORS,
        clusters=CLUSTERS,
        templates=partial(marker_templates, geometry=geometry),
        adjacent=ADJACENT,
        motions=MOTIONS,
        reference=("walk", "squat"),
        facts={
            "lengths_m": {"thigh": geometry.thigh_m, "shank": geometry.shank_m},
            "joint_centers_m": {  # in the frame of the proximal part
                "hip_in_pelvis": list(geometry.hip_in_pelvis),
                "knee_in_thigh": [0.0, 0.0, -geometry.thigh_m],
                "ankle_in_shank": [0.0, 0.0, -geometry.shank_m],
            },
        },
        chain=LEG_CHAIN,
    )


LIMBS: Mapping[str, LimbKind] = {
    "leg": leg(LegGeometry()),
    "legs": LEGS,
    "arm": ARM,
    "trunk": TRUNK,
}
"""All limbs by name."""
