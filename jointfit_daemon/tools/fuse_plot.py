"""Flexion by every method beside the reference, and RMS errors. Law: draws, computes nothing."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.tools.plotting import new_figure

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.calibration.offline import Judged, Judgement


def draw_judgement(path: Path, found: Judgement) -> None:
    """Write one figure, a row a trial; its format is the ending of the name."""
    trials = list(found.reference)
    figure = new_figure(12.0, 3.2 * len(trials) + 0.6)
    figure.suptitle(f"judged on {found.held_out}")
    for line, trial in zip(
        figure.subplots(len(trials), 2, squeeze=False, width_ratios=(3, 2)), trials, strict=True
    ):
        rows = [row for row in found.rows if row.trial == trial]
        _bars(line[1], rows)
        joint = next(iter(found.reference[trial]), None)
        if joint is None:
            line[0].set_axis_off()
            continue
        truth = np.rad2deg(found.reference[trial][joint])
        for row in rows:
            if not row.method.startswith("single"):
                line[0].plot(np.rad2deg(row.flexion[joint]), linewidth=0.8, label=row.method)
        line[0].plot(truth, "k", linewidth=1.2, label="reference")
        line[0].set_title(f"{trial}: {joint} flexion", fontsize=10)
        line[0].set_xlabel("frame")
        line[0].set_ylabel("deg")
        line[0].grid(alpha=0.3)
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8)
    figure.savefig(path, dpi=120)


def _bars(axes: Any, rows: Sequence[Judged]) -> None:
    names = [*rows[0].segments, *(f"{joint} flexion" for joint in rows[0].joints)]
    width = 0.8 / len(names)
    for k, name in enumerate(names):
        values = [np.rad2deg([*row.segments.values(), *row.joints.values()][k]) for row in rows]
        axes.barh(np.arange(len(rows)) + k * width, values, width, label=name)
    axes.set_yticks(
        np.arange(len(rows)) + 0.4 - width / 2, [row.method for row in rows], fontsize=7
    )
    axes.invert_yaxis()
    axes.set_xlabel("RMS error, deg")
    axes.legend(fontsize=7)
