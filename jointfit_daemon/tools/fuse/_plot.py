"""Plot of an evaluation: flexion of each method with the reference, and RMS errors."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.tools.plotting import new_figure

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.calibration.phases import MethodEvaluation, MethodScore

ROW_INCHES = 3.2
"""Height of one row of plots, inches."""


def draw_evaluation(path: Path, found: MethodEvaluation) -> None:
    """Write one figure with a row per joint and trial; the file extension determines the format."""
    joints = [*found.rows[0].joints] or [""]
    lines = [(trial, joint) for trial in found.reference for joint in joints]
    figure = new_figure(13.0, ROW_INCHES * len(lines) + 0.6)
    figure.suptitle(f"hold-out: {found.held_out}")
    axes = figure.subplots(len(lines), 2, squeeze=False, width_ratios=(3, 2))
    for (left, right), (trial, joint) in zip(axes, lines, strict=True):
        rows = [row for row in found.rows if row.trial == trial]
        if joint:
            _flexions(left, found, rows, joint)
        else:  # a single segment has no joint between segments
            left.set_axis_off()
        if joint == joints[0]:
            _bars(right, rows)
        else:
            right.set_axis_off()

    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8)
    figure.savefig(path, dpi=120)


def _flexions(axes: Any, found: MethodEvaluation, rows: Sequence[MethodScore], joint: str) -> None:
    trial = rows[0].trial
    t_s = found.t_s[trial]
    for row in rows:
        alone = row.method.startswith("single")
        width, style = (0.6, ":") if alone else (0.9, "-")
        angle = np.rad2deg(row.flexion[joint])
        axes.plot(t_s, angle, style, linewidth=width, label=row.method)

    truth = np.rad2deg(found.reference[trial][joint])
    axes.plot(t_s, truth, "k", linewidth=1.2, label="reference")
    axes.set_title(f"{trial}: {joint} flexion", fontsize=10)
    axes.set_xlabel("s")
    axes.set_ylabel("deg")
    axes.grid(alpha=0.3)


def _bars(axes: Any, rows: Sequence[MethodScore]) -> None:
    names = [*rows[0].segments, *(f"{joint} flexion" for joint in rows[0].joints)]
    width = 0.8 / len(names)
    for k, name in enumerate(names):
        values = [np.rad2deg([*row.segments.values(), *row.joints.values()][k]) for row in rows]
        axes.barh(np.arange(len(rows)) + k * width, values, width, label=name)

    axes.set_yticks(
        np.arange(len(rows)) + 0.4 - width / 2, [row.method for row in rows], fontsize=7
    )
    axes.invert_yaxis()
    axes.set_title(f"{rows[0].trial}: RMS error", fontsize=10)
    axes.set_xlabel("deg")
    axes.legend(fontsize=7, loc="upper left", bbox_to_anchor=(1.0, 0.75))
