"""Plot of a refinement: residual and displacement of each marker, and error of each trial."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jointfit_daemon.tools.plotting import new_figure
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.calibration.marker_refinement import Refinement

_BEFORE, _AFTER, _MOVED = "tab:gray", "tab:blue", "tab:orange"


def draw_refinement(path: Path, found: Refinement) -> None:
    """Write one figure; the file extension determines the format."""
    figure = new_figure(11.0, max(4.0, 0.22 * len(found.markers) + 1.5))
    left, right = figure.subplots(1, 2, width_ratios=(2, 1))
    figure.suptitle(f"{found.model.name}: {found.method}")

    # Draw the residual of each marker before and after the refinement, and its displacement.
    places = np.arange(len(found.markers))
    before = [MM_PER_M * m.rms_before for m in found.markers]
    after = [MM_PER_M * m.rms_after for m in found.markers]
    moved = [MM_PER_M * m.distance for m in found.markers]
    left.hlines(places, before, after, color=_BEFORE, linewidth=1.0)
    left.plot(before, places, "o", color=_BEFORE, label="residual before")
    left.plot(after, places, "o", color=_AFTER, label="residual after")
    left.plot(moved, places, "|", color=_MOVED, markersize=9, label="displacement")
    left.set_yticks(places, [m.name for m in found.markers], fontsize=7)
    left.invert_yaxis()
    left.set_xlabel("mm")
    left.grid(alpha=0.3)
    left.legend(fontsize=8)

    # Draw the tracking error of each trial before and after the refinement.
    places = np.arange(len(found.trials))
    right.barh(places - 0.2, [MM_PER_M * t.before.rms for t in found.trials], 0.4, color=_BEFORE)
    right.barh(places + 0.2, [MM_PER_M * t.after.rms for t in found.trials], 0.4, color=_AFTER)
    names = [f"{t.name}\n{'training' if t.trained else 'validation'}" for t in found.trials]
    right.set_yticks(places, names, fontsize=8)
    right.invert_yaxis()
    right.set_xlabel("RMS tracking error, mm")
    right.grid(axis="x", alpha=0.3)
    figure.savefig(path, dpi=120)
