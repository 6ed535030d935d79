"""Joints of a chain as text (mm, degrees), as JSON (SI units) and as trajectory files."""

from __future__ import annotations

from dataclasses import replace
from math import degrees, isfinite
from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.files.mocap import write_trc
from jointfit_daemon.tools.center import _report
from jointfit_daemon.tools.center.chain import longest_gap_s
from jointfit_daemon.tools.text_output import align_columns

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from jointfit_daemon.files.mocap import MarkerTrial
    from jointfit_daemon.tools.center.chain import ChainJoint

ENDINGS = (".trc", ".csv")
"""File extensions of trajectory files."""
_CENTERS = ("joint", "seen from", "center, mm", "error, mm", "arc", "residual, mm", "T", "")
_TRAJECTORIES = ("joint", "known", "longest gap, s", "error, mm", "sides apart, mm")


def text(trial: MarkerTrial, joints: Sequence[ChainJoint]) -> str:
    """Return two tables as text: the joint centres, and a summary of the trajectories."""
    data = trial.trajectories
    centers = [_CENTERS]
    for joint in joints:
        for side in joint.sides:
            e = side.answer.estimate
            row = (
                joint.name,
                ",".join(side.parent),
                _report.point(e.center),
                _report.mm(_report.error_seen(side.answer)),
                f"{degrees(e.arc):.0f}°",
                _report.mm(e.residual),
                _report.number(e.conditioning),
                "" if e.refused is None else f"REFUSED: {e.refused}",
            )
            centers.append(row)

    trajectories = [_TRAJECTORIES, *(_trajectory_row(joint, data.rate_hz) for joint in joints)]
    notes = [f"note      {joint.name}: {fact}" for joint in joints for fact in _notes(joint)]
    head = (
        f"trial     {len(data.t_s)} frames at {data.rate_hz:g} Hz,"
        f" {len(data.t_s) / data.rate_hz:.2f} s; {trial.up_axis} is up ({trial.up_said_by})"
    )
    warnings = [f"warning   {line}" for line in data.warnings]
    tables = [
        align_columns(centers, right=(3, 4, 5, 6)),
        "",
        align_columns(trajectories, range(1, 5)),
    ]
    return "\n".join([head, *warnings, "", *tables, *([""] if notes else []), *notes])


def _trajectory_row(joint: ChainJoint, rate_hz: float) -> tuple[str, ...]:
    track = joint.trajectory
    known = np.isfinite(track.error)
    apart = _report.mm(track.sides_apart)
    if not isfinite(track.sides_apart):
        apart = "refused" if joint.refused else "one side"
    return (
        joint.name,
        f"{100 * known.mean():.0f} %",
        f"{longest_gap_s(joint, rate_hz):.2f}",
        _report.mm(float(np.median(track.error[known]))) if known.any() else "unknown",
        apart,
    )


def _notes(joint: ChainJoint) -> Iterator[str]:
    used = [s.answer.estimate for s in joint.sides if s.answer.estimate.refused is None]
    if used and all(len(e.unseen) for e in used):
        yield "its position along the joint axis is unobservable; its error excludes this direction"
    yield from joint.faults


def as_json(trial: MarkerTrial, joints: Sequence[ChainJoint]) -> dict[str, Any]:
    """Return all joints in SI units; NaN and infinity become null."""
    return {
        "frames": len(trial.trajectories.t_s),
        "rate_hz": trial.trajectories.rate_hz,
        "up_axis": trial.up_axis,
        "joints": [
            {
                "name": joint.name,
                "known": float(np.isfinite(joint.trajectory.error).mean()),
                "longest_gap_s": longest_gap_s(joint, trial.trajectories.rate_hz),
                "sides_apart_m": joint.trajectory.sides_apart,
                "faults": list(joint.faults),
                "sides": [
                    {"parent": list(side.parent), "parent_rms_m": side.rms}
                    | _report.answer_json(side.answer)
                    for side in joint.sides
                ],
                "position_m": joint.trajectory.positions.tolist(),
                "error_m": joint.trajectory.error.tolist(),
            }
            for joint in joints
        ],
    }


def write_trajectories(path: Path, trial: MarkerTrial, joints: Sequence[ChainJoint]) -> None:
    """Write the joint positions in the axes of the marker file; missing positions are empty.

    A ``.trc`` file contains the joints as markers. A ``.csv`` file contains positions and their
    predicted RMS errors, m.
    """
    data = trial.trajectories
    positions = np.stack([joint.trajectory.positions for joint in joints], axis=1)
    if path.suffix.lower() == ".trc":
        names = tuple(joint.name for joint in joints)
        write_trc(path, replace(data, names=names, positions=positions, warnings=()))
        return

    columns = [f"{j.name}_{key}_m" for j in joints for key in ("x", "y", "z", "error")]
    errors = np.stack([joint.trajectory.error for joint in joints], axis=1)[..., None]
    cells = np.concatenate((positions, errors), axis=2).reshape(len(data.t_s), -1)
    rows = (
        ",".join(f"{x:.9g}" if isfinite(x) else "" for x in row)
        for row in np.column_stack((data.t_s, cells)).tolist()
    )
    path.write_text("\n".join((",".join(("t_s", *columns)), *rows)) + "\n", encoding="utf-8")
