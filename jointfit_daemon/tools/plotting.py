"""Figures without a screen. Law: matplotlib is optional and slow to import: only on demand."""

from __future__ import annotations

from typing import Any


class PlotMissing(ImportError):  # noqa: N818 - named for what happened
    """Matplotlib is not installed; the message says how to get it."""

    def __init__(self) -> None:
        super().__init__("drawing needs matplotlib: pip install 'jointfitd[plot]'")


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure, inches, that draws to files only.

    Raises
    ------
    PlotMissing
        Matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as missing:
        raise PlotMissing from missing
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
