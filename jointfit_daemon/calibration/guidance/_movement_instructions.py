"""Instructions for the subject by kind of joint, and general instructions for other joints."""

from __future__ import annotations

from math import radians
from typing import NamedTuple


class JointInstructions(NamedTuple):
    """Instructions for one kind of joint."""

    bend: str
    """Movement about the main axis."""
    sideways: str
    """Movement about a second axis."""
    hinge: bool = False
    """Whether the joint has one main axis. The position of its center along that axis is then taken
    from the static pose.
    """
    arc: float = radians(40.0)
    """Smallest arc, rad, that a joint must cover to train the soft-tissue models.

    The limit applies to joints with sensors on both segments."""


_GENERAL_INSTRUCTIONS = JointInstructions("bend and stretch it as far as it goes", "circle it")
_INSTRUCTIONS = {
    "hip": JointInstructions("squat, and swing the leg forward and back", "swing the leg sideways"),
    "knee": JointInstructions(
        "squat, sit down and stand up", "turn the foot in and out", hinge=True, arc=radians(60.0)
    ),
    "ankle": JointInstructions(
        "lift the foot and bend it up and down", "circle the foot", hinge=True
    ),
    "shoulder": JointInstructions("swing the arm forward and back", "swing the arm sideways"),
    "elbow": JointInstructions(
        "bend and stretch the arm", "turn the palm up and down", hinge=True, arc=radians(60.0)
    ),
    "wrist": JointInstructions("bend the hand up and down", "circle the hand", hinge=True),
    **dict.fromkeys(
        ("trunk", "spine", "lumb"),
        JointInstructions("bend forward and straighten up", "bend and turn to both sides"),
    ),
    **dict.fromkeys(
        ("neck", "cervic"),
        JointInstructions("nod: bend the head forward and back", "turn and bend the head sideways"),
    ),
}


def instructions_for(joint: str) -> JointInstructions:
    """Return the instructions for a joint name: ``hip``, ``right_hip`` and ``Hip R`` are hips."""
    name = joint.casefold()
    return next(
        (words for part, words in _INSTRUCTIONS.items() if part in name), _GENERAL_INSTRUCTIONS
    )
