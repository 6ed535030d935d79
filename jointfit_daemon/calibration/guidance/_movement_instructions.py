"""What a wearer is told to do with a joint: plain words, by the kind of joint.

Law: words only. A joint whose name is not known is spoken of in general terms, never wrongly.
"""

from __future__ import annotations

from math import radians
from typing import NamedTuple


class JointWords(NamedTuple):
    """What to tell of one kind of joint."""

    bend: str
    """How to move it about its main axis."""
    sideways: str
    """How to move it about a second axis."""
    hinge: bool = False
    """It moves about one axis by nature, or hardly about others: where the center lies along it
    comes from the static pose, and nobody is asked to show it."""
    arc: float = radians(40.0)
    """Least arc of a joint between two sensors, rad: what the regression must have seen."""


_GENERAL = JointWords("bend and stretch it as far as it goes", "circle it")
_WORDS = {
    "hip": JointWords("squat, and swing the leg forward and back", "swing the leg sideways"),
    "knee": JointWords(
        "squat, sit down and stand up", "turn the foot in and out", hinge=True, arc=radians(60.0)
    ),
    "ankle": JointWords("lift the foot and bend it up and down", "circle the foot", hinge=True),
    "shoulder": JointWords("swing the arm forward and back", "swing the arm sideways"),
    "elbow": JointWords(
        "bend and stretch the arm", "turn the palm up and down", hinge=True, arc=radians(60.0)
    ),
    "wrist": JointWords("bend the hand up and down", "circle the hand", hinge=True),
}


def words_for(joint: str) -> JointWords:
    """Return the words for a joint by its name: ``hip``, ``right_hip`` and ``Hip R`` are hips."""
    name = joint.casefold()
    return next((words for part, words in _WORDS.items() if part in name), _GENERAL)
