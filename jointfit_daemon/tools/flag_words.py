"""Sentences that describe the flags of poses.

The web page of the dashboard has the same sentences (``page/js/words.js``). Invariant: every flag
has a sentence.
"""

from __future__ import annotations

_FLAGS = {
    "uncalibrated": "Not calibrated: angles are unknown.",
    "headings_from_static": "Headings come from the static pose: there was no align phase.",
    "same_pose_assumed": "The static pose was recorded without cameras; the same pose as before is"
    " assumed.",
    "stuck": "% repeats its value and is not used.",
    "slipped": "% moved on the body and is not used.",
    "pair_disagrees": "The two sensors of % contradict each other: check their straps.",
    "heading_disagrees": "Magnetic disturbance at the %: angles are corrected, headings are"
    " uncertain.",
    "heading_unseen": "The limb may have turned about the vertical; joint angles are not affected.",
    "one_sensor": "Only one sensor of % contributes.",
    "held": "No data from the sensors of %: the last orientation is held.",
    "lost": "No data from the sensors of %.",
    "untrained": "% is outside the movements of the calibration: its error may be larger"
    " than in the calibration.",
    "extrapolating": "A sensor is late and was extrapolated.",
    "origin_fixed": "The cameras do not see the first joint.",
    "axis_vertical": "% uses the vertical as its axis: the calibration found no joint centre.",
    "axis_from_shoulder": "Axes of % come from the shoulder alone: calibrate with elbow flexion.",
    "facing_unknown": "The flexion axis is unknown; the subject is assumed to have faced the y axis"
    " of the world.",
    "uncorrected": "Sensors are used without correction (procedure of the patent).",
    "gimbal": "Gimbal lock: flexion and rotation cannot be separated.",
}
_MINOR = {"extrapolating", "headings_from_static", "origin_fixed", "uncorrected"}
"""Flags that require no action of the user."""


def flag_sentence(flag: str) -> str:
    """Return the sentence that describes a flag of a pose; return an unknown flag unchanged."""
    kind, _, name = flag.partition(":")
    return _FLAGS.get(kind, flag).replace("%", name.replace("_", " "))


def serious_flags(flags: list[str]) -> list[str]:
    """Return the flags that may require an action of the user."""
    return [flag for flag in flags if flag.partition(":")[0] not in _MINOR]
