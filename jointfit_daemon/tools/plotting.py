"""Figures for files. Matplotlib is optional and slow to import, so it is imported on demand."""

from __future__ import annotations

from typing import Any


class PlottingUnavailableError(ImportError):
    """Matplotlib is not installed."""

    def __init__(self) -> None:
        super().__init__("plots need matplotlib: pip install 'jointfitd[plot]'")


def new_figure(width: float, height: float) -> Any:
    """Return an empty figure of the given size, inches, without a display.

    Raises
    ------
    PlottingUnavailableError
        Matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ModuleNotFoundError as missing:
        raise PlottingUnavailableError from missing

    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure
