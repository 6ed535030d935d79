r"""The truth of a run, one JSON object a line, for whoever judges the estimator.

Law: what was, not what was measured. Optical world, z up; m, rad; quaternions (w, x, y, z). No
line tells the future: a line is written after its instant, and reaches the file within 0.2 s.

First line: ``{"truth": 1, "t_ns": …, "knobs": {…}, "lengths_m": {…}, "q_segment_sensor": {…}, …}``.
Then, 100 a second::

    {"t_ns": host CLOCK_MONOTONIC, "motion": "walk",
     "q_world_segment": {"pelvis": [w, x, y, z], "thigh": …, "shank": …, "foot": …},
     "joint_m": {"hip": [x, y, z], "knee": …, "ankle": …},
     "knee": {"flexion": …, "adduction": …, "rotation": …}, "included": …}

Knee flexion is positive with the heel back, adduction with the foot towards the midline, rotation
with the toes towards the midline; the included angle is pi when straight. Unknown is null.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, BinaryIO

import orjson

from jointfit_simulators.body import to_wxyz

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    import numpy as np
    from numpy.typing import NDArray

    from jointfit_simulators.body import Rotation, Truth

VERSION = 1
_OPTIONS = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE


class TruthLog:
    """A file that grows by the truth as it happens.

    Parameters
    ----------
    path
        Where; overwritten.
    facts
        The first line.
    """

    def __init__(self, path: Path, facts: Mapping[str, object]) -> None:
        self._file: BinaryIO = path.open("wb")
        self._file.write(orjson.dumps({"truth": VERSION, **facts}, option=_OPTIONS))
        self._file.flush()
        self._waiting: deque[tuple[int, bytes]] = deque()

    def add(
        self, t_ns: NDArray[np.int64], motions: list[str], truth: Truth, world: Rotation
    ) -> None:
        """Keep the truth of a block until it has happened.

        Parameters
        ----------
        t_ns
            Instants, host time, shape (n,).
        motions
            What was going on at each.
        truth
            In the base world.
        world
            Base world to the optical world.
        """
        turns = {part: to_wxyz(world * turn).tolist() for part, turn in truth.orientations.items()}
        joints = {joint: world.apply(center).tolist() for joint, center in truth.joints.items()}
        for i, (at, motion) in enumerate(zip(t_ns.tolist(), motions, strict=True)):
            flexion, adduction, rotation = truth.knee[i].tolist()
            line = {
                "t_ns": at,
                "motion": motion,
                "q_world_segment": {part: turn[i] for part, turn in turns.items()},
                "joint_m": {joint: center[i] for joint, center in joints.items()},
                "knee": {"flexion": flexion, "adduction": adduction, "rotation": rotation},
                "included": float(truth.included[i]),
            }
            self._waiting.append((at, orjson.dumps(line, option=_OPTIONS)))

    def advance(self, now_ns: int) -> None:
        """Write what has happened by `now_ns`."""
        waiting = self._waiting
        while waiting and waiting[0][0] <= now_ns:
            self._file.write(waiting.popleft()[1])
        self._file.flush()

    def close(self) -> None:
        """Close the file; what has not happened is not told."""
        self._file.close()
