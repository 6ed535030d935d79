"""Plot of child markers in the parent frame with the estimated centre, in three projections.

Both axes have equal scales, and the 95 % ellipse is drawn to this scale. An unobservable direction
is drawn as a line. The ellipse then covers the remaining directions.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.tools.center.trial import CHI2_95
from jointfit_daemon.tools.plotting import new_figure
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.tools.center.trial import ParentFrameMotion, WindowEstimate

_MOST_POINTS = 600
"""Largest number of plotted samples of a marker. It limits the size of vector graphics."""
_END_ON = 0.1
"""Smallest projected length of a unit vector whose direction is drawn as a line."""


def draw_center(
    path: Path,
    reduced: ParentFrameMotion,
    markers: Sequence[str],
    found: Sequence[WindowEstimate],
    title: str,
) -> None:
    """Write one figure; the file extension determines the format."""
    points = reduced.movement.points
    if points is None:
        return

    sides = ((0, 1),) if points.shape[-1] == len("xy") else ((0, 1), (1, 2), (0, 2))
    figure = new_figure(4.8 * len(sides) + 1.6, 5.2)
    figure.suptitle(title)
    step = max(1, len(points) // _MOST_POINTS)
    for axes, side in zip(figure.subplots(1, len(sides), squeeze=False)[0], sides, strict=True):
        for k, name in enumerate(markers):
            x, y = MM_PER_M * points[::step, k, side[0]], MM_PER_M * points[::step, k, side[1]]
            axes.plot(x, y, ".", markersize=2.5, label=name)
        for number, answer in enumerate(found):
            _center(axes, answer, side, labelled=number == 0)

        axes.set_aspect("equal", adjustable="datalim")
        axes.set_xlabel(f"{'xyz'[side[0]]} of the parent, mm")
        axes.set_ylabel(f"{'xyz'[side[1]]} of the parent, mm")
        axes.grid(alpha=0.3)

    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", fontsize=8)
    figure.savefig(path, dpi=120)


def _center(axes: Any, answer: WindowEstimate, side: tuple[int, int], *, labelled: bool) -> None:
    e = answer.estimate
    if not np.isfinite(e.center).all():
        return

    at = MM_PER_M * e.center[list(side)]
    refused = e.refused is not None
    label = ("centre, refused" if refused else "centre, 95 % ellipse") if labelled else None
    axes.plot(*at, "kx" if refused else "k+", markersize=9, label=label)
    if refused:
        return

    for direction in e.unseen[:, list(side)]:
        if np.hypot(*direction) > _END_ON:
            along = "unknown along this line" if labelled else None
            axes.axline(at, at + direction, color="k", ls="--", linewidth=0.8, label=along)

    values, vectors = np.linalg.eigh(e.covariance[np.ix_(side, side)])
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    rank = len(e.center) - len(e.unseen)
    scale = 1.0 if e.within95 is None or rank < 1 else e.within95 / CHI2_95[rank]
    lengths = MM_PER_M * np.sqrt(scale * CHI2_95[2] * np.maximum(values, 0.0))
    outline = vectors @ (lengths[:, None] * np.stack((np.cos(turn), np.sin(turn))))
    axes.plot(at[0] + outline[0], at[1] + outline[1], "k-", linewidth=0.8)
