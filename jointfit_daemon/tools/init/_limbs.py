"""Limbs that the dialogue offers, corresponding to the rigs in the folder ``examples``."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Mapping

_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class Limb:
    """One limb with its segments from proximal to distal, and proposals for sensors and markers."""

    text: str
    """Description for the list of choices."""
    places: Mapping[str, tuple[str, ...]]
    """Proposed sensor positions on each segment, by segment name."""
    prefixes: Mapping[str, tuple[str, ...]]
    """Usual prefixes of marker names on each body part. The first prefix is proposed."""
    joints: tuple[str, ...] = ()
    """Joints from proximal to distal; empty for a branched limb."""
    branches: tuple[Mapping[str, str], ...] = ()
    """Tables ``[[chain.joint]]`` of a branched limb; empty for other limbs."""
    ends: Mapping[str, str] = field(default_factory=lambda: _NOTHING)
    """Body parts that have markers but no sensors, by the keys ``proximal`` and ``distal``."""
    lengths_m: Mapping[str, float] = field(default_factory=lambda: _NOTHING)
    """Proposed lengths of the segments that motion capture does not measure, m."""
    has_side: bool = True
    """Whether the limb is on one side of the body."""
    is_planar: bool = False
    """Whether the limb moves in a plane and only cameras measure it."""

    @property
    def segments(self) -> tuple[str, ...]:
        """Segments from proximal to distal."""
        return tuple(self.places)

    @property
    def optional_parts(self) -> tuple[str, ...]:
        """Body parts adjacent to the limb. Their markers are not required."""
        children = [joint.get("child") for joint in self.branches]
        parts = [*self.ends.values(), *children]
        return tuple(part for part in parts if part and part not in self.places)

    def end_of(self, segment: str) -> str | None:
        """Return the body part distal to `segment`; None at the end of the limb."""
        for joint in self.branches:
            if joint["parent"] == segment:
                return joint.get("child")
        at = self.segments.index(segment) + 1
        return self.segments[at] if at < len(self.segments) else self.ends.get("distal")


def _leg_joints(side: str) -> tuple[dict[str, str], ...]:
    thigh, shank = f"{side}_thigh", f"{side}_shank"
    return (
        {"name": f"{side}_hip", "parent": "pelvis", "child": thigh, "side": side},
        {"name": f"{side}_knee", "parent": thigh, "child": shank},
        {"name": f"{side}_ankle", "parent": shank, "child": f"{side}_foot"},
    )


_TWO = ("front", "side")

LIMBS: Mapping[str, Limb] = {
    "knee": Limb(
        "thigh and shank of one leg",
        places={"thigh": _TWO, "shank": _TWO},
        prefixes={
            "pelvis": ("PL", "P"),
            "thigh": ("T",),
            "shank": ("S", "C"),
            "foot": ("F",),
        },
        joints=("hip", "knee", "ankle"),
        ends={"proximal": "pelvis", "distal": "foot"},
    ),
    "legs": Limb(
        "both legs with their pelvis",
        places={
            "pelvis": ("sacrum", "side"),
            "right_thigh": _TWO,
            "right_shank": _TWO,
            "left_thigh": _TWO,
            "left_shank": _TWO,
        },
        prefixes={
            "pelvis": ("P", "PL"),
            "right_thigh": ("RT",),
            "right_shank": ("RC", "RS"),
            "left_thigh": ("LT",),
            "left_shank": ("LC", "LS"),
            "right_foot": ("RF",),
            "left_foot": ("LF",),
        },
        branches=(*_leg_joints("right"), *_leg_joints("left")),
        has_side=False,
    ),
    "arm": Limb(
        "thorax, upper arm, forearm and hand",
        places={
            "thorax": ("sternum",),
            "upper_arm": _TWO,
            "forearm": _TWO,
            "hand": ("back",),
        },
        prefixes={
            "thorax": ("X",),
            "upper_arm": ("U",),
            "forearm": ("A",),
            "hand": ("H",),
        },
        joints=("acromion", "shoulder", "elbow", "wrist", "knuckles"),
        lengths_m={"thorax": 0.05, "hand": 0.09},
    ),
    "trunk": Limb(
        "thorax and pelvis",
        places={"thorax": ("sternum", "back"), "pelvis": ("sacrum", "side")},
        prefixes={"head": ("E",), "thorax": ("X",), "pelvis": ("P",)},
        joints=("neck", "lumbar", "hips"),
        ends={"proximal": "head"},
        lengths_m={"pelvis": 0.1},
        has_side=False,
    ),
    "planar": Limb(
        "leg in a plane, with cameras alone",
        places={"thigh": (), "shank": ()},
        prefixes={"pelvis": ("P",), "thigh": ("T",), "shank": ("C", "S"), "foot": ("F",)},
        joints=("hip", "knee", "ankle"),
        ends={"proximal": "pelvis", "distal": "foot"},
        is_planar=True,
    ),
}
