r"""Log of the ground truth of a run, with one JSON object per line.

The values are true, not measured. They are in the optical world (z up), in m and rad, with
quaternions (w, x, y, z). The movement of the subject is computed in the *base world* (z up), and
the optical world is the base world rotated about the vertical.

Invariant: no line is written before its time. `advance` writes all lines whose time has passed. A
running scene calls it every 0.1 s, so a line is in the file within 0.2 s.

The first line is ``{"truth": 1, "t_ns": …, "knobs": {…}, "lengths_m": {…}, "joint": "knee", …}``.
The other lines follow at 100 Hz::

    {"t_ns": host CLOCK_MONOTONIC, "motion": "walk",
     "q_world_segment": {"pelvis": [w, x, y, z], "thigh": …, "shank": …, "foot": …},
     "joint_m": {"hip": [x, y, z], "knee": …, "ankle": …},
     "knee": {"flexion": …, "adduction": …, "rotation": …}, "included": …}

The angles belong to the main joint: ``knee``, ``right_knee``, ``elbow`` or ``lumbar``. Knee flexion
is positive with the heel back, adduction with the foot towards the midline, and rotation with the
toes towards the midline. Elbow flexion is positive forward, and rotation is pronation. Lumbar
flexion is positive forward, ``adduction`` is bending to the right, and rotation is positive to the
left. The included angle is pi when straight. An unknown value is null.
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

    from jointfit_simulators.body import GroundTruth, Rotation

VERSION = 1
"""Version of the format, which the first line contains."""
_OPTIONS = orjson.OPT_SERIALIZE_NUMPY | orjson.OPT_APPEND_NEWLINE


class TruthLog:
    """Writer of the log of the ground truth.

    Parameters
    ----------
    path
        Output file. An existing file is overwritten.
    facts
        Contents of the first line.
    """

    def __init__(self, path: Path, facts: Mapping[str, object]) -> None:
        self._file: BinaryIO = path.open("wb")
        self._file.write(orjson.dumps({"truth": VERSION, **facts}, option=_OPTIONS))
        self._file.flush()
        self._queued: deque[tuple[int, bytes]] = deque()

    def add(
        self, t_ns: NDArray[np.int64], motions: list[str], truth: GroundTruth, world: Rotation
    ) -> None:
        """Queue the ground truth of a block of time, which the scene computes in advance.

        Parameters
        ----------
        t_ns
            Host times, ns, shape (n,).
        motions
            Name of the motion at each time.
        truth
            Ground truth in the base world.
        world
            Rotation from the base world to the optical world.
        """
        turns = {part: to_wxyz(world * turn).tolist() for part, turn in truth.orientations.items()}
        joints = {joint: world.apply(center).tolist() for joint, center in truth.joints.items()}

        for i, (at, motion) in enumerate(zip(t_ns.tolist(), motions, strict=True)):
            flexion, adduction, rotation = truth.angles[i].tolist()
            line = {
                "t_ns": at,
                "motion": motion,
                "q_world_segment": {part: turn[i] for part, turn in turns.items()},
                "joint_m": {joint: center[i] for joint, center in joints.items()},
                truth.joint: {"flexion": flexion, "adduction": adduction, "rotation": rotation},
                "included": float(truth.included[i]),
            }
            self._queued.append((at, orjson.dumps(line, option=_OPTIONS)))

    def advance(self, now_ns: int) -> None:
        """Write the queued lines up to `now_ns`."""
        while self._queued and self._queued[0][0] <= now_ns:
            self._file.write(self._queued.popleft()[1])
        self._file.flush()

    def close(self) -> None:
        """Close the file and discard queued lines."""
        self._file.close()
