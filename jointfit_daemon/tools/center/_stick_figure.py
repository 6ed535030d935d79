"""Stick figure of a chain over time, in one or two views, with the paths of the joints.

Both axes have equal scales. A chain has no joint at its ends, so the figure ends at the mean of the
markers of the first and of the last segment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.tools.plotting import new_figure
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.files.mocap import MarkerTrial
    from jointfit_daemon.tools.center.chain import ChainJoint

_POSTURES = 12
"""Number of drawn postures, distributed over the trial."""


def draw_stick_figure(
    path: Path,
    trial: MarkerTrial,
    segments: Sequence[Sequence[str]],
    joints: Sequence[ChainJoint],
    plane: Axis | None,
) -> None:
    """Write one figure in the axes of the file; the file extension selects the format."""
    from matplotlib import colormaps

    in_file = [trial.to_file(trial.points(list(segment))) for segment in segments]
    ends = [in_file[0].mean(axis=1), in_file[-1].mean(axis=1)]
    line = np.stack([ends[0], *(j.trajectory.positions for j in joints), ends[1]], axis=1)

    complete = np.flatnonzero(np.isfinite(line).all(axis=(1, 2)))
    if complete.size == 0:  # no frame is complete, so draw the visible parts
        complete = np.arange(len(line))
    shown = complete[np.linspace(0, complete.size - 1, _POSTURES).round().astype(int)]
    colors = colormaps["viridis"](np.linspace(0.0, 0.9, len(shown)))

    up = "xyz".index(trial.up_axis)
    sides = [k for k in range(3) if k != up and "xyz"[k] != plane]
    if plane == trial.up_axis:  # the movement is horizontal, so draw the view from above
        sides, up = sides[:1], sides[1]
    figure = new_figure(5.6 * len(sides) + 1.4, 5.6)
    for axes, across in zip(figure.subplots(1, len(sides), squeeze=False)[0], sides, strict=True):
        for joint in joints:
            track = MM_PER_M * joint.trajectory.positions
            axes.plot(track[:, across], track[:, up], color="0.7", linewidth=0.8)
        for frame, color in zip(shown, colors, strict=True):
            posture = MM_PER_M * line[frame]
            axes.plot(posture[:, across], posture[:, up], "-", color=color, linewidth=1.4)
            axes.plot(posture[1:-1, across], posture[1:-1, up], "o", color=color, markersize=4)
            seen = MM_PER_M * np.concatenate([points[frame] for points in in_file])
            axes.plot(seen[:, across], seen[:, up], ".", color=color, markersize=2.5)
        for joint, at in zip(joints, MM_PER_M * line[shown[0], 1:-1], strict=True):
            if np.isfinite(at).all():
                axes.annotate(joint.name, (at[across], at[up]), (4, 4), textcoords="offset points")

        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel(f"{'xyz'[across]} of the file, mm")
        axes.set_ylabel(f"{'xyz'[up]} of the file, mm")
        axes.grid(alpha=0.3)

    t_s = trial.trajectories.t_s[shown]
    figure.suptitle(f"{len(shown)} postures from {t_s[0]:.2f} s (dark) to {t_s[-1]:.2f} s (light)")
    figure.savefig(path, dpi=120)
