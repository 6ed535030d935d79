"""Segment lengths and the position of the first joint, from options and from reference files.

Forward kinematics computes joint positions from the lengths and this position. Lengths are in m,
and positions are in the world of the project (z up), m.
"""

from __future__ import annotations

from itertools import pairwise
from math import isfinite
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jointfit_daemon.limb_model import proximal_segment
from jointfit_daemon.nearest_name import unknown_name
from jointfit_daemon.tools.fuse._tables import FEWEST, UnusableInputError, read_recording

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from jointfit_daemon.model import Chain, Vector
    from jointfit_daemon.tools.fuse._trial import LimbDescription

LONGEST_M = 3.0
"""Upper limit of a segment length, m; larger numbers are probably millimetres."""
_COORDINATES = 3
_MAD_TO_SD = 1.4826
"""Ratio of standard deviation to median absolute deviation of a normal distribution."""


class MeasuredLength(NamedTuple):
    """Length of a segment, m."""

    length: float
    sd: float
    """Standard deviation, m; 0 for a length given as an option."""


def parse_lengths(texts: Sequence[str], segments: Sequence[str]) -> dict[str, float]:
    """Parse ``--length SEGMENT=METRES`` options.

    Raises
    ------
    UnusableInputError
        The segment is unknown or repeated, or the value is not a length in metres.
    """
    found: dict[str, float] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        length = _number(value)
        if not equals or length is None:
            raise UnusableInputError(
                f"--length {text!r}: expected SEGMENT=METRES, such as thigh=0.42"
            )
        if name not in segments:
            problem = unknown_name("segment", name, segments)
            raise UnusableInputError(f"--length {text!r}: {problem}")
        if name in found:
            raise UnusableInputError(f"--length: {name} appears more than once: give it once")
        if not 0.0 < length < LONGEST_M:
            raise UnusableInputError(
                f"--length {text!r}: expected more than 0 and less than {LONGEST_M:g} m: "
                "convert the length to metres"
            )
        found[name] = length
    return found


def parse_origin(text: str | None) -> Vector | None:
    """Parse the option ``--origin X,Y,Z``, m; return None if the option is missing.

    Raises
    ------
    UnusableInputError
        The text does not consist of three finite numbers.
    """
    if text is None:
        return None
    numbers = [_number(part) for part in text.split(",")]
    known = [number for number in numbers if number is not None]
    if len(numbers) != _COORDINATES or len(known) != _COORDINATES:
        raise UnusableInputError(
            f"--origin {text!r}: expected X,Y,Z of the first joint in metres, z up, such as 0,0,0.9"
        )
    return known[0], known[1], known[2]


def segment_lengths(
    texts: Sequence[str], trials: Iterable[tuple[Path, Path | None]], limb: LimbDescription
) -> dict[str, MeasuredLength]:
    """Return segment lengths from ``--length`` options, or else from the reference files.

    Parameters
    ----------
    texts
        Values of the options ``--length``, see `parse_lengths`.
    trials
        Sensor file and, if separate, reference file of each trial.
    limb
        Segments and their names in the reference files.

    Raises
    ------
    UnusableInputError
        The errors of `parse_lengths`, or distances between bone origins that are not plausible
        segment lengths in metres.
    """
    given = parse_lengths(texts, limb.chain.segments)
    references = (reference or sensors for sensors, reference in trials)
    found = _measured_lengths(references, limb)
    return found | {segment: MeasuredLength(length, 0.0) for segment, length in given.items()}


def _measured_lengths(
    references: Iterable[Path], limb: LimbDescription
) -> dict[str, MeasuredLength]:
    """Return the lengths of segments whose two joint centers are in the reference files.

    Only NPZ files contain origins of bones (``p_BONE``). The origin of a bone is its proximal joint
    center. The length of a segment is the median distance from its origin to the origin of the next
    segment, over all files. With fewer than `FEWEST` distances, the length remains unknown. The
    standard deviation of the length is robust (median absolute deviation). The last segment has no
    next segment, so its length remains unknown.
    """
    arrays = [path for path in references if path.suffix.lower() == ".npz"]
    recordings = [read_recording(path, limb.up) for path in arrays]
    found = {}
    for segment, distal in pairwise(limb.chain.segments):
        above, below = limb.bones[segment], limb.bones[distal]
        distances = [
            np.linalg.norm(table.origins[below] - table.origins[above], axis=1)
            for table in recordings
            if above in table.origins and below in table.origins
        ]
        known = np.concatenate(distances) if distances else np.empty(0)
        known = known[np.isfinite(known)]
        if len(known) < FEWEST:
            continue

        length = float(np.median(known))
        if not 0.0 < length < LONGEST_M:
            raise UnusableInputError(
                f"p_{above} and p_{below} are {length:.3g} m apart, expected more than 0 and less "
                f"than {LONGEST_M:g} m: store the proximal joint center of each bone in metres, or"
                " omit both arrays"
            )
        sd = _MAD_TO_SD * float(np.median(np.abs(known - length)))
        found[segment] = MeasuredLength(length, sd)
    return found


def placed_joints(chain: Chain, lengths: Sequence[float | None]) -> dict[int, str]:
    """Return number and name of every joint whose position follows from the known lengths.

    If only the first joint has a known position, the result is empty, because this joint is the
    origin.
    """
    placed = {0: chain.joints[0]}
    for joint in range(1, len(chain.joints)):
        segment = proximal_segment(chain, joint)
        if segment is not None and segment in placed and lengths[segment] is not None:
            placed[joint] = chain.joints[joint]
    return placed if len(placed) > 1 else {}


def left_out_positions(chain: Chain, lengths: Sequence[float | None]) -> str | None:
    """Return a note on joints without position, with a remedy; None if all have a position."""
    known = dict(zip(chain.segments, lengths, strict=True))
    unknown = [segment for segment, length in known.items() if length is None]
    if not unknown:
        return None
    placed = placed_joints(chain, lengths)
    left_out = [name for i, name in enumerate(chain.joints) if i > 0 and i not in placed]
    options = " ".join(f"--length {segment}=METRES" for segment in unknown)
    return (
        f"positions of {', '.join(left_out)} left out, because the length of "
        f"{', '.join(unknown)} is unknown: add {options}"
    )


def _number(text: str) -> float | None:
    """Return the number in a text; None if the text is not a finite number."""
    try:
        number = float(text)
    except ValueError:
        return None
    return number if isfinite(number) else None
