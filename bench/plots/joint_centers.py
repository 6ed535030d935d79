"""Plots of recorded trials: marker paths, estimated centers, and centers of the models.

The plots show two views of every joint in parent coordinates, perpendicular to the main axis of
rotation and along it, with equal scales. Rejected estimates are drawn in a light colour, with the
reason.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from bench.baselines.center_estimators import EstimatedCenters, hinge, judged
from bench.experiments.joint_center.real_trials import METHODS, TRIALS
from bench.framework.experiment import DATA
from jointfit_daemon.center_of_rotation.planar import plane_of
from jointfit_daemon.tools.plotting import new_figure
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from numpy.typing import NDArray

_MOST = 400
_REACH_MM = 260.0
_COLORS = ("tab:blue", "tab:orange")


def draw(folder: Path) -> Iterator[Path]:
    """Write one PNG per trial; yield their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    for trial in TRIALS:
        joints = judged(DATA, trial, METHODS)
        figure = new_figure(4.4 * len(joints), 8.8)
        figure.suptitle(f"{trial}: centers of rotation in the parent's coordinates, mm")
        panels = figure.subplots(2, len(joints))
        for column, found in enumerate(joints):
            across = plane_of(hinge(found.reduced))
            along = np.column_stack((hinge(found.reduced), across[:, 0]))
            _panel(panels[0, column], found, across, ("across the axis 1", "across the axis 2"))
            _panel(panels[1, column], found, along, ("along the axis", "across the axis 1"))
            panels[0, column].set_title(_title(found), fontsize=9)
        handles, labels = panels[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=4, fontsize=9)
        path = folder / f"joint-center-{trial}.png"
        figure.savefig(path, dpi=100)
        yield path


def _title(found: EstimatedCenters) -> str:
    lines = [found.joint.name]
    for method in METHODS:
        e = found.estimates[method]
        claimed = "refused" if e.refused else f"claimed ±{MM_PER_M * e.rms_error:.0f}"
        claimed = "position along the axis unknown" if len(e.unseen) else claimed
        if not np.isfinite(e.center).all():
            lines.append(f"{method}: refused")
            continue
        lines.append(
            f"{method}: {MM_PER_M * found.off(method):.0f} mm from the model,"
            f" {MM_PER_M * found.off_axis(method):.0f} across;\n{claimed}"
        )
    return "\n".join(lines)


def _panel(
    axes: Any, found: EstimatedCenters, view: NDArray[np.float64], labels: tuple[str, str]
) -> None:
    """Draw one view; `view` maps parent coordinates to panel coordinates, shape (3, 2)."""
    points = found.reduced.movement.points
    assert points is not None
    origin = found.model @ view
    step = max(1, len(points) // _MOST)
    for k in range(points.shape[1]):
        path = MM_PER_M * (points[::step, k] @ view - origin)
        axes.plot(*path.T, ".", color="0.7", markersize=2, label="markers" if k == 0 else None)
    turn = np.linspace(0.0, 2.0 * np.pi, 61)
    rest = MM_PER_M * found.wander
    axes.plot(0.0, 0.0, "r+", markersize=12, label="model's center, mean")
    axes.plot(
        rest * np.cos(turn), rest * np.sin(turn), "r-", lw=0.8, label="RMS distance from the mean"
    )
    for color, method in zip(_COLORS, METHODS, strict=False):
        e = found.estimates[method]
        if not np.isfinite(e.center).all():
            continue
        at = MM_PER_M * (e.center @ view - origin)
        faint = 0.35 if e.refused else 1.0
        inside = np.abs(at).max() <= _REACH_MM
        axes.plot(*at, "x", color=color, alpha=faint, markersize=9, mew=2, label=method)
        values, vectors = np.linalg.eigh(view.T @ e.covariance @ view)
        lengths = MM_PER_M * np.sqrt(5.991 * np.maximum(values, 0.0))
        outline = vectors @ (lengths[:, None] * np.stack((np.cos(turn), np.sin(turn))))
        axes.plot(*(at[:, None] + outline), "-", color=color, alpha=faint, lw=1)
        if not inside:
            axes.annotate(
                f"{method}: outside",
                (0.02, 0.02 + 0.05 * METHODS.index(method)),
                xycoords="axes fraction",
                color=color,
                fontsize=8,
            )
    axes.set_xlim(-_REACH_MM, _REACH_MM)
    axes.set_ylim(-_REACH_MM, _REACH_MM)
    axes.set_aspect("equal")
    axes.set_xlabel(labels[0], fontsize=8)
    axes.set_ylabel(labels[1], fontsize=8)
    axes.grid(alpha=0.3)
