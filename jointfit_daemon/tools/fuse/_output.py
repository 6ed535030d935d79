"""Applies a model to recorded sensors and writes orientations and joint angles.

Invariant: runs the fusion of the daemon frame by frame, so results equal those of a live rig.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.orientations import (
    OrientationTable,
    OrientationTrial,
    TimeTable,
    write_orientations_npz,
    write_orientations_sto,
    write_sto,
)
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.limb_model import visible
from jointfit_daemon.model import Chain

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.tools.fuse._tables import OrientationRecording


ANGLES = ("flexion", "adduction", "rotation")
ENDINGS = (".sto", ".npz", ".csv")
_UNKNOWN = (float("nan"),) * 4


@dataclass(frozen=True, slots=True)
class FusedTrial:
    """Fused limb over time."""

    t_s: Array
    segments: Mapping[str, Array]
    """q_world_segment, z up, shape (n, 4); NaN where unknown."""
    sd: Mapping[str, Array]
    """Standard deviation of each segment, rad, shape (n,)."""
    angles: Mapping[str, Array]
    """Flexion, adduction, internal rotation of each inner joint, rad, shape (n, 3)."""
    angle_sd: Mapping[str, Array]
    """Standard deviation of flexion, rad, shape (n,)."""
    flags: Mapping[str, float]
    """Share of frames with each flag, 0 to 1."""

    @property
    def known(self) -> dict[str, float]:
        """Return the share of frames with an orientation, by segment, 0 to 1."""
        return {s: float(visible(q).mean()) for s, q in self.segments.items()}


def chain_of(calibration: Calibration, *, left: bool) -> Chain:
    """Return the kinematic chain of a calibration."""
    return Chain(
        calibration.joints, calibration.segments, calibration.chain_sensors, left_side=left
    )


def fuse_trial(calibration: Calibration, table: OrientationRecording, *, left: bool) -> FusedTrial:
    """Fuse recorded sensors frame by frame; NaN orientations count as missing sensors."""
    chain = chain_of(calibration, left=left)
    fuser = LimbFuser(chain, calibration)
    columns = {name: q.tolist() for name, q in table.q.items()}
    seen = {name: visible(q) for name, q in table.q.items()}
    states = []
    for k, t_s in enumerate(table.t_s.tolist()):
        alive = {name: tuple(columns[name][k]) for name in columns if seen[name][k]}
        t_ns = round(t_s * 1e9)
        states.append(fuser.fuse(t_ns, t_ns, k, alive))

    flags = Counter(flag for state in states for flag in state.flags)
    inner = range(1, len(chain.joints) - 1)
    return FusedTrial(
        table.t_s,
        {
            name: np.array([state.segments[i].q_world_segment or _UNKNOWN for state in states])
            for i, name in enumerate(chain.segments)
        },
        {
            name: np.array([state.segments[i].sd for state in states], np.float64)
            for i, name in enumerate(chain.segments)
        },
        {
            chain.joints[i]: np.array([state.joints[i].angles or _UNKNOWN[:3] for state in states])
            for i in inner
        },
        {
            chain.joints[i]: np.array([state.joints[i].angle_sd for state in states], np.float64)
            for i in inner
        },
        {flag: count / len(states) for flag, count in sorted(flags.items())},
    )


def write_fused(path: Path, found: FusedTrial, table: OrientationRecording, up: Axis) -> list[Path]:
    """Write a fused trial in the format of the file extension; return the files written.

    ``.sto``: orientations, and joint angles in a second file ``NAME_angles.sto`` (degrees).
    ``.npz``: readable by `read_orientations_npz`, with ``angles_JOINT``, ``sd_SEGMENT`` (rad).
    ``.csv``: all columns in one table.
    """
    kind = path.suffix.lower()
    if kind == ".npz":
        write_orientations_npz(path, OrientationTrial(found.t_s, table.q, found.segments, {}))
        with np.load(path, allow_pickle=False) as arrays:
            all_arrays = {name: arrays[name] for name in arrays.files}
        all_arrays |= {f"angles_{joint}": angles for joint, angles in found.angles.items()}
        all_arrays |= {f"sd_flexion_{joint}": sd for joint, sd in found.angle_sd.items()}
        all_arrays |= {f"sd_{segment}": sd for segment, sd in found.sd.items()}
        np.savez_compressed(path, allow_pickle=False, **all_arrays)
        return [path]

    # Angles and standard deviations as columns, degrees
    names, columns = [], []
    for joint, angles in found.angles.items():
        names += [f"{joint}_{angle}" for angle in ANGLES] + [f"{joint}_flexion_sd"]
        columns += [*angles.T, found.angle_sd[joint]]
    for segment, sd in found.sd.items():
        names.append(f"{segment}_sd")
        columns.append(sd)
    values = np.rad2deg(np.stack(columns, axis=1))

    if kind == ".csv":
        quaternions = [f"{segment}_q{part}" for segment in found.segments for part in "wxyz"]
        head = ",".join(("t_s", *quaternions, *(f"{name}_deg" for name in names)))
        cells = np.column_stack((found.t_s, *found.segments.values(), values))
        rows = (",".join(f"{x:.9g}" if isfinite(x) else "" for x in row) for row in cells.tolist())
        path.write_text("\n".join((head, *rows)) + "\n", encoding="utf-8")
        return [path]

    rate_hz = float(np.round(1.0 / np.median(np.diff(found.t_s)), 6))
    q = np.stack(list(found.segments.values()), axis=1)
    turned = q[..., [0, 2, 3, 1]] if up == "y" else q
    write_orientations_sto(
        path, OrientationTable(tuple(found.segments), found.t_s, turned, rate_hz)
    )
    second = path.with_name(f"{path.stem}_angles.sto")
    write_sto(
        second, TimeTable(tuple(names), found.t_s, values, in_degrees=True, name="joint angles")
    )
    return [path, second]
