"""Applies a model to recorded sensors; writes orientations, joint angles and joint positions.

Invariant: the results equal those of a live rig, because the fusion of the daemon processes the
trial frame by frame.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from math import isfinite
from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.files.axes import from_z_up
from jointfit_daemon.files.orientations import (
    OrientationTable,
    OrientationTrial,
    TimeTable,
    WrittenTable,
    write_known_orientations,
    write_known_values,
    write_orientations_npz,
)
from jointfit_daemon.fusion import LimbFuser
from jointfit_daemon.kinematics.joint_angles import read_patent
from jointfit_daemon.limb_model import configured_length, inner_joints, visible
from jointfit_daemon.model import ANGLE_NAMES, AngleConvention, Chain
from jointfit_daemon.tools.fuse._lengths import left_out_positions, placed_joints
from jointfit_daemon.tools.fuse._notes import calibration_notes

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    from jointfit_daemon.arrays import Array
    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.limb_model import Calibration, InnerJoint
    from jointfit_daemon.model import LimbState, Vector
    from jointfit_daemon.tools.fuse._tables import OrientationRecording


PATENT_ANGLES = ("alpha", "beta", "gamma", "joint")
ENDINGS = (".sto", ".mot", ".npz", ".csv")
_UNKNOWN = (float("nan"),) * 5


@dataclass(frozen=True, slots=True)
class FusedAngles:
    """Angles of one joint over time, rad; NaN where unknown."""

    anatomical: Array
    """Joint angles as defined by `convention`, rad, shape (n, 3)."""
    main_sd: Array
    """Standard deviation of the main angle (flexion or elevation), rad, shape (n,)."""
    inner: Array
    """Inner angle between the two segments, rad, shape (n,)."""
    patent: Array
    """Joint angles `PATENT_ANGLES` as defined by the patent CN 114533039 B, rad, shape (n, 4)."""
    patent_gimbal: Array
    """Whether the angles in `patent` are in gimbal lock, 1 or 0, shape (n,)."""
    convention: AngleConvention
    """Definition of the angles in `anatomical`."""

    @property
    def main_angle(self) -> str:
        """Name of the angle to which `main_sd` belongs."""
        return "elevation" if self.convention is AngleConvention.ELEVATION else "flexion"


@dataclass(frozen=True, slots=True)
class FusedPosition:
    """Position of one joint over time, m, z up; NaN where unknown."""

    position: Array
    """Position, m, shape (n, 3)."""
    sd: Array
    """Standard deviation per axis, m, shape (n,)."""


@dataclass(frozen=True, slots=True)
class FusedTrial:
    """Fused limb over time."""

    t_s: Array
    segments: Mapping[str, Array]
    """Segment orientations q_world_segment, z up, shape (n, 4); NaN where unknown."""
    sd: Mapping[str, Array]
    """Standard deviation of each segment orientation, rad, shape (n,)."""
    angles: Mapping[str, FusedAngles]
    """Angles of each joint between two segments, by joint."""
    positions: Mapping[str, FusedPosition]
    """Positions of the joints, by joint, up to the first segment of unknown length. The mapping is
    empty if the length of the first segment is unknown."""
    flags: Mapping[str, float]
    """Share of frames with each flag, 0 to 1."""
    notes: tuple[str, ...] = ()
    """Notes on missing quantities, each with its remedy."""

    @property
    def known(self) -> dict[str, float]:
        """Return the share of frames with an orientation, by segment, 0 to 1."""
        return {s: float(visible(q).mean()) for s, q in self.segments.items()}


def chain_of(
    calibration: Calibration,
    *,
    left: bool,
    lengths: Mapping[str, float] | None = None,
    origin: Vector | None = None,
) -> Chain:
    """Return the kinematic chain of a calibration; `lengths` (m) replace its stored lengths."""
    given = lengths or {}
    return Chain(
        calibration.joints,
        calibration.segments,
        calibration.chain_sensors,
        left_side=left,
        origin=origin,
        lengths=tuple(given.get(segment) for segment in calibration.segments),
        parents=calibration.parents,
        left_joints=calibration.left_joints,
    )


def fuse_trial(calibration: Calibration, table: OrientationRecording, chain: Chain) -> FusedTrial:
    """Fuse recorded sensors frame by frame; NaN means that a sensor has no data in a frame.

    Parameters
    ----------
    calibration : Calibration
    table : OrientationRecording
        Sensor orientations of the trial.
    chain : Chain
        Kinematic chain of the calibration, see `chain_of`.
    """
    fuser = LimbFuser(chain, calibration)
    columns = {name: q.tolist() for name, q in table.q.items()}
    seen = {name: visible(q) for name, q in table.q.items()}
    states = []
    for k, t_s in enumerate(table.t_s.tolist()):
        alive = {name: tuple(columns[name][k]) for name in columns if seen[name][k]}
        t_ns = round(t_s * 1e9)
        states.append(fuser.fuse(t_ns, t_ns, k, alive))

    # A joint position needs the lengths of all segments up to the joint. If only the first joint
    # has a known position, this joint is the origin and needs no column.
    configured = [configured_length(chain, i) for i in range(len(chain.segments))]
    lengths = [
        calibration.segment[name].length if length is None else length
        for name, length in zip(chain.segments, configured, strict=True)
    ]
    note = left_out_positions(chain, lengths)
    placed = placed_joints(chain, lengths)

    flags = Counter(flag for state in states for flag in state.flags)
    return FusedTrial(
        table.t_s,
        {
            name: np.array([state.segments[i].q_world_segment or _UNKNOWN[:4] for state in states])
            for i, name in enumerate(chain.segments)
        },
        {
            name: np.array([state.segments[i].sd for state in states], np.float64)
            for i, name in enumerate(chain.segments)
        },
        {joint.name: _joint_over_time(states, joint) for joint in inner_joints(chain)},
        {
            name: FusedPosition(
                np.array([state.joints[i].position or _UNKNOWN[:3] for state in states]),
                np.array([state.joints[i].position_sd for state in states], np.float64),
            )
            for i, name in placed.items()
        },
        {flag: count / len(states) for flag, count in sorted(flags.items())},
        (*calibration_notes(calibration, table.q, left=chain.left_side), *filter(None, [note])),
    )


def _joint_over_time(states: Sequence[LimbState], joint: InnerJoint) -> FusedAngles:
    """Return the angles of a joint between two segments."""
    joints = [state.joints[joint.number] for state in states]
    ends = [[segment.q_world_segment for segment in state.segments] for state in states]
    patent = np.array(
        [
            _UNKNOWN if above is None or below is None else read_patent(above, below)
            for above, below in [(q[joint.proximal], q[joint.distal]) for q in ends]
        ]
    )
    return FusedAngles(
        np.array([joint.angles or _UNKNOWN[:3] for joint in joints]),
        np.array([joint.angle_sd for joint in joints], np.float64),
        np.array([joint.inner for joint in joints], np.float64),
        patent[:, :-1],
        patent[:, -1],
        joints[0].convention,
    )


def write_fused(
    path: Path, found: FusedTrial, table: OrientationRecording, up: Axis
) -> list[WrittenTable]:
    """Write a fused trial in the format of the file extension; return one result for each file.

    ``.sto``: orientations. Joint angles (degrees) are in a second file, ``NAME_angles.sto``. Known
    joint positions (m) are in a third file, ``NAME_positions.sto``.
    ``.mot``: joint angles (degrees) and positions (m) in one table. Orientations are omitted,
    because a cell of a MOT file contains one number.
    ``.npz``: a file for `read_orientations_npz`, with joint quantities by name, rad and m.
    ``.csv``: all columns in one table.

    An STO or MOT file contains the part of its table that is known, see `files.orientations`, and
    has the vertical axis `up`. NPZ and CSV files are z up.
    """
    kind = path.suffix.lower()
    if kind in {".npz", ".csv"}:
        if kind == ".npz":
            _write_npz(path, found, table)
        else:
            _write_csv(path, found)
        return [WrittenTable(path, len(found.t_s))]

    angles, positions = _angle_columns(found), _position_columns(found, up)
    if kind == ".mot":
        name = "joint angles and positions"
        return [_write_numbers(path, found.t_s, angles | positions, in_degrees=True, name=name)]

    rate_hz = float(np.round(1.0 / np.median(np.diff(found.t_s)), 6))
    q = np.stack(list(found.segments.values()), axis=1)
    turned = q[..., [0, 2, 3, 1]] if up == "y" else q
    fused = OrientationTable(tuple(found.segments), found.t_s, turned, rate_hz)
    files = [write_known_orientations(path, fused)]
    second = path.with_name(f"{path.stem}_angles.sto")
    files.append(_write_numbers(second, found.t_s, angles, in_degrees=True, name="joint angles"))
    if positions:
        third = path.with_name(f"{path.stem}_positions.sto")
        name = "joint positions"
        files.append(_write_numbers(third, found.t_s, positions, in_degrees=False, name=name))
    return files


def _angle_columns(found: FusedTrial) -> dict[str, Array]:
    """Return angles and standard deviations as columns, degrees; a gimbal flag is 0 or 1."""
    columns: dict[str, Array] = {}
    for joint, angles in found.angles.items():
        anatomical = zip(
            ANGLE_NAMES[angles.convention], np.rad2deg(angles.anatomical.T), strict=True
        )
        patent = zip(PATENT_ANGLES, np.rad2deg(angles.patent.T), strict=True)
        columns |= {f"{joint}_{name}": column for name, column in anatomical}
        columns[f"{joint}_{angles.main_angle}_sd"] = np.rad2deg(angles.main_sd)
        columns[f"{joint}_inner"] = np.rad2deg(angles.inner)
        columns |= {f"{joint}_patent_{name}": column for name, column in patent}
        columns[f"{joint}_patent_gimbal"] = angles.patent_gimbal
    return columns | {f"{segment}_sd": np.rad2deg(sd) for segment, sd in found.sd.items()}


def _position_columns(found: FusedTrial, up: Axis) -> dict[str, Array]:
    """Return joint positions and their standard deviations as columns, m; `up` is vertical."""
    columns: dict[str, Array] = {}
    for joint, place in found.positions.items():
        columns |= zip(
            [f"{joint}_{axis}" for axis in "xyz"], from_z_up(place.position, up).T, strict=True
        )
        columns[f"{joint}_position_sd"] = place.sd
    return columns


def _write_npz(path: Path, found: FusedTrial, table: OrientationRecording) -> None:
    write_orientations_npz(path, OrientationTrial(found.t_s, table.q, found.segments, {}))
    with np.load(path, allow_pickle=False) as arrays:
        all_arrays = {name: arrays[name] for name in arrays.files}
    for joint, angles in found.angles.items():
        all_arrays[f"angles_{joint}"] = angles.anatomical
        all_arrays[f"sd_{angles.main_angle}_{joint}"] = angles.main_sd
        all_arrays[f"inner_{joint}"] = angles.inner
        all_arrays[f"patent_{joint}"] = angles.patent
        all_arrays[f"patent_gimbal_{joint}"] = angles.patent_gimbal
    for joint, place in found.positions.items():
        all_arrays[f"position_{joint}"] = place.position
        all_arrays[f"sd_position_{joint}"] = place.sd
    all_arrays |= {f"sd_{segment}": sd for segment, sd in found.sd.items()}
    np.savez_compressed(path, allow_pickle=False, **all_arrays)


def _write_csv(path: Path, found: FusedTrial) -> None:
    columns = {"t_s": found.t_s}
    for segment, q in found.segments.items():
        columns |= zip([f"{segment}_q{part}" for part in "wxyz"], q.T, strict=True)
    for name, angles in _angle_columns(found).items():
        columns[name if name.endswith("_gimbal") else f"{name}_deg"] = angles
    columns |= {f"{name}_m": column for name, column in _position_columns(found, "z").items()}

    cells = np.column_stack(list(columns.values()))
    rows = (",".join(f"{x:.9g}" if isfinite(x) else "" for x in row) for row in cells.tolist())
    path.write_text("\n".join((",".join(columns), *rows)) + "\n", encoding="utf-8")


def _write_numbers(
    path: Path, t_s: Array, columns: Mapping[str, Array], *, in_degrees: bool, name: str
) -> WrittenTable:
    values = np.column_stack(list(columns.values()))
    table = TimeTable(tuple(columns), t_s, values, in_degrees=in_degrees, name=name)
    return write_known_values(path, table)
