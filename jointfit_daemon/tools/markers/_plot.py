"""Plot of a refinement: residual and displacement of each marker, error of each trial."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.tools.plotting import new_figure

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.calibration.marker_refinement import Refinement

_MM = 1000.0
_BEFORE, _AFTER, _MOVED = "tab:gray", "tab:blue", "tab:orange"


def draw_refinement(path: Path, found: Refinement) -> None:
    """Write one figure; the file extension selects the format."""
    figure = new_figure(11.0, max(4.0, 0.22 * len(found.markers) + 1.5))
    markers, trials = figure.subplots(1, 2, width_ratios=(2, 1))
    figure.suptitle(f"{found.model.name}: {found.method}")
    _draw_markers(markers, found)
    _draw_trials(trials, found)
    figure.savefig(path, dpi=120)


def _draw_markers(axes: Any, found: Refinement) -> None:
    places = np.arange(len(found.markers))
    before = [_MM * m.rms_before for m in found.markers]
    after = [_MM * m.rms_after for m in found.markers]
    moved = [_MM * m.distance for m in found.markers]
    axes.hlines(places, before, after, color=_BEFORE, linewidth=1.0)
    axes.plot(before, places, "o", color=_BEFORE, label="residual before")
    axes.plot(after, places, "o", color=_AFTER, label="residual after")
    axes.plot(moved, places, "|", color=_MOVED, markersize=9, label="displacement")
    axes.set_yticks(places, [m.name for m in found.markers], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("mm")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)


def _draw_trials(axes: Any, found: Refinement) -> None:
    places = np.arange(len(found.trials))
    axes.barh(places - 0.2, [_MM * t.before.rms for t in found.trials], 0.4, color=_BEFORE)
    axes.barh(places + 0.2, [_MM * t.after.rms for t in found.trials], 0.4, color=_AFTER)
    names = [f"{t.name}\n{'training' if t.trained else 'validation'}" for t in found.trials]
    axes.set_yticks(places, names, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("RMS tracking error, mm")
    axes.grid(axis="x", alpha=0.3)
