"""Error maps of the numerical experiment as figures.

A map shows the error over two of three quantities: the angle α between two successive positions of
the marker, its distance r from the centre of rotation, and the noise σ per coordinate. All maps of
a row share one colour scale, which is clipped to limit the effect of outliers. Cells without an
estimate are hatched.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jointfit_daemon.tools.plotting import new_figure
from jointfit_daemon.units import MM_PER_M

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.center_of_rotation.study import PairMaps

_TOP_MM = {"α–σ": 50.0, "r–σ": 15.0, "r–α": 20.0}
"""Upper end of the colour scale of each row, mm."""
_SOURCE = (
    ("predicted", "F  prediction (equation 15)"),
    ("three frames", "A  analytic, three frames"),
    ("grid", "G  grid, node on the truth"),
)
_OURS = (
    ("shifted grid", "three frames, grid shifted by half a step"),
    ("bound", "Cramér-Rao bound, all frames"),
    ("hyper", "hyper, all frames"),
    ("oriented", "orientation-aided, all frames"),
)
_AXES = {"α": ("α, deg", float(np.rad2deg(1.0))), "σ": ("σ, mm", MM_PER_M), "r": ("r, m", 1.0)}


def draw_study(study: Sequence[PairMaps], folder: Path) -> list[Path]:
    """Write figure 2 of the publication and the maps of the other estimators, as PNG and SVG."""
    written: list[Path] = []
    for name, methods, title in (
        ("cor-study-figure-2", _SOURCE, "RMS error of the center, three frames"),
        (
            "cor-study-estimators",
            _OURS,
            "RMS error of the center: shifted grid, and all frames of the same arcs",
        ),
    ):
        figure = _figure(study, methods, title)
        for suffix in ("png", "svg"):
            written.append(folder / f"{name}.{suffix}")
            figure.savefig(written[-1], dpi=130)

    return written


def _figure(study: Sequence[PairMaps], methods: Sequence[tuple[str, str]], title: str) -> Any:
    figure = new_figure(3.1 * len(methods) + 0.9, 8.6)
    figure.suptitle(title)
    grid = figure.subplots(len(study), len(methods), squeeze=False)
    for axes_row, pair in zip(grid, study, strict=True):
        # Draw one map for each method. The row quantity increases upwards.
        row_name, column_name = pair.name.split("–")
        (y_label, y_scale), (x_label, x_scale) = _AXES[row_name], _AXES[column_name]
        last = None
        for axes, (key, label) in zip(axes_row, methods, strict=True):
            axes.set_facecolor("white")
            axes.patch.set_hatch("////")
            axes.patch.set_edgecolor("0.7")
            last = axes.pcolormesh(
                pair.columns * x_scale,
                pair.rows * y_scale,
                np.ma.masked_invalid(MM_PER_M * pair.maps[key]),
                vmin=0.0,
                vmax=_TOP_MM[pair.name],
                cmap="viridis",
                shading="nearest",
                rasterized=True,
            )
            axes.set_xlabel(x_label)
            axes.set_ylabel(y_label)
            if pair is study[0]:
                axes.set_title(label, fontsize=10)
        bar = figure.colorbar(last, ax=list(axes_row), extend="max", shrink=0.9)
        bar.set_label("mm")

    return figure
