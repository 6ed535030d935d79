"""Charts as SVG text: axes, lines, bands and points. The style sheet defines colours and fonts.

Invariant: every text of a caller is escaped, and no element refers to another file.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from math import ceil, floor, isfinite, log10
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from numpy.typing import NDArray

    from jointfit_daemon.arrays import Array

WIDE, NARROW = 920.0, 343.0
"""Widths of the two drawings of a chart, CSS pixels. Large screens and paper show the wide drawing;
phones show the narrow drawing."""
_TICK_STEPS = (1.0, 2.0, 5.0, 10.0)
_TIME_STEPS_S = (
    0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 15.0, 30.0, 60.0, 120.0, 300.0, 600.0, 900.0, 1800.0,
    3600.0, 7200.0, 14400.0,
)  # fmt: skip
_MINUTES_FROM_S = 180.0
"""Duration from which the time axis is labelled in minutes and seconds, s."""


@dataclass(frozen=True, slots=True)
class PlotArea:
    """Plot area within an image, with the scales of its axes."""

    width: float
    height: float
    x: tuple[float, float]
    """Values of the horizontal axis at the left and the right edge."""
    y: tuple[float, float]
    """Values of the vertical axis at the lower and the upper edge."""
    left: float = 44.0
    right: float = 8.0
    top: float = 24.0
    bottom: float = 26.0

    def x_px(self, values: Array | float) -> Array:
        """Return the horizontal positions of values, px."""
        span = (self.x[1] - self.x[0]) or 1.0
        inner = self.width - self.left - self.right
        return self.left + (np.asarray(values) - self.x[0]) / span * inner

    def y_px(self, values: Array | float) -> Array:
        """Return the vertical positions of values, px."""
        span = (self.y[1] - self.y[0]) or 1.0
        inner = self.height - self.top - self.bottom
        return self.top + (self.y[1] - np.asarray(values)) / span * inner

    @property
    def columns(self) -> int:
        """Number of pixel columns of the plot area."""
        return max(2, int(self.width - self.left - self.right))


def image(width: float, height: float, label: str, parts: Iterable[str], kind: str = "") -> str:
    """Return an SVG image with a text alternative."""
    return (
        f'<svg class="chart {kind}" viewBox="0 0 {width:.0f} {height:.0f}" role="img"'
        f' aria-label="{escape(label)}">{"".join(parts)}</svg>'
    )


def responsive(draw: Callable[[float, str], str]) -> str:
    """Return a chart in two drawings; `draw` receives the width and CSS class of each drawing."""
    return draw(WIDE, "wide") + draw(NARROW, "narrow")


def nice_ticks(low: float, high: float, most: int) -> list[float]:
    """Return at most `most` + 1 round values from `low` to `high`; [low] for an empty range."""
    span = high - low
    if not isfinite(span) or span <= 0.0:
        return [low]
    raw = span / most
    power = 10.0 ** floor(log10(raw))
    step = next(s * power for s in _TICK_STEPS if s * power >= raw * (1.0 - 1e-9))
    return [k * step for k in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1)]


def time_ticks(low: float, high: float, most: int) -> list[float]:
    """Return round times from `low` to `high`, s."""
    step = next((s for s in _TIME_STEPS_S if (high - low) / s <= most), _TIME_STEPS_S[-1])
    return [k * step for k in range(ceil(low / step - 1e-9), floor(high / step + 1e-9) + 1)]


def time_text(t_s: float, span_s: float) -> str:
    """Return a time as text: in seconds, or in minutes and seconds if `span_s` is long."""
    if span_s < _MINUTES_FROM_S:
        return f"{t_s:g}"
    minutes, seconds = divmod(round(t_s), 60)
    return f"{minutes}:{seconds:02d}"


def pad_limits(
    low: float, high: float, share: float = 0.08, least: float = 1.0
) -> tuple[float, float]:
    """Return the limits of an axis with a margin at both ends.

    The margin is `share` times the range of values, or larger if the range is less than `least`.
    """
    if not (isfinite(low) and isfinite(high)):
        return 0.0, 1.0
    margin = max(share * (high - low), 0.5 * max(0.0, least - (high - low)), 1e-6)
    return low - margin, high + margin


def frame(
    area: PlotArea,
    x_ticks: Iterable[tuple[float, str]],
    y_ticks: Iterable[tuple[float, str]],
    y_title: str = "",
) -> str:
    """Return the grid, the tick labels, and the title of the vertical axis."""
    x0, x1 = area.left, area.width - area.right
    y0 = area.height - area.bottom
    parts = []
    for value, text in y_ticks:
        y = float(area.y_px(value))
        zero = " zero" if value == 0.0 else ""
        parts.append(
            f'<line class="grid{zero}" x1="{x0:.1f}" x2="{x1:.1f}" y1="{y:.1f}" y2="{y:.1f}"/>'
            f'<text class="tick" x="{x0 - 6:.1f}" y="{y + 4:.1f}" text-anchor="end">{escape(text)}'
            "</text>"
        )
    for value, text in x_ticks:
        x = float(area.x_px(value))
        anchor = "end" if x > x1 - 10 and len(text) > 3 else "middle"  # noqa: PLR2004 - three digits fit
        parts.append(
            f'<line class="mark" x1="{x:.1f}" x2="{x:.1f}" y1="{y0:.1f}" y2="{y0 + 4:.1f}"/>'
            f'<text class="tick" x="{x:.1f}" y="{y0 + 17:.1f}" text-anchor="{anchor}">'
            f"{escape(text)}</text>"
        )
    parts.append(f'<line class="axis" x1="{x0:.1f}" x2="{x1:.1f}" y1="{y0:.1f}" y2="{y0:.1f}"/>')
    if y_title:
        parts.append(f'<text class="title" x="2" y="10">{escape(y_title)}</text>')
    return "".join(parts)


def svg_text(kind: str, x: float, y: float, text: str, anchor: str) -> str:
    """Return a text; `anchor` is ``start``, ``middle`` or ``end``."""
    return (
        f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{escape(text)}</text>'
    )


def degree_ticks(area: PlotArea, most: int = 5) -> list[tuple[float, str]]:
    """Return ticks of a vertical axis in degrees."""
    return [(value, number(value)) for value in nice_ticks(*area.y, most)]


def second_ticks(area: PlotArea, unit: str = " s") -> list[tuple[float, str]]:
    """Return ticks of a horizontal time axis; the last label has the unit."""
    most = max(3, int(area.columns / 70))
    span = area.x[1] - area.x[0]
    found = time_ticks(*area.x, most)
    if span >= _MINUTES_FROM_S:
        unit = " min"
    last = len(found) - 1
    return [(t, time_text(t, span) + (unit if k == last else "")) for k, t in enumerate(found)]


def number(value: float) -> str:
    """Return a number with a typographic minus sign, or a dash if it is unknown."""
    if not isfinite(value):
        return "–"
    text = f"{value:.6g}"
    return "0" if text == "-0" else text.replace("-", "−")


def line(area: PlotArea, x: Array, y: Array, kind: str) -> str:
    """Return a line; each pixel column shows the extremes of its values. NaN is a gap."""
    if len(x) > 2 * area.columns:
        x, low, high = column_extremes(area, x, y, y)
        x, y = np.repeat(x, 2), np.column_stack([low, high]).ravel()
    x_px, y_px = area.x_px(x), area.y_px(y)
    parts = []
    for start, end in runs(np.isfinite(x_px) & np.isfinite(y_px)):
        pairs = zip(x_px[start:end], y_px[start:end], strict=True)
        parts.append("M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in pairs))
    return f'<path class="line {kind}" d="{"".join(parts)}"/>' if parts else ""


def band(area: PlotArea, x: Array, low: Array, high: Array, kind: str) -> str:
    """Return a filled band between two lines; NaN is a gap."""
    if len(x) > area.columns:
        x, low, high = column_extremes(area, x, low, high)
    known = np.isfinite(low) & np.isfinite(high)
    x_px, low_px, high_px = area.x_px(x), area.y_px(low), area.y_px(high)
    parts = []
    for start, end in runs(known):
        points = [
            *zip(x_px[start:end], high_px[start:end], strict=True),
            *zip(x_px[start:end][::-1], low_px[start:end][::-1], strict=True),
        ]
        parts.append("M" + "L".join(f"{a:.1f} {b:.1f}" for a, b in points) + "Z")
    return f'<path class="band {kind}" d="{"".join(parts)}"/>' if parts else ""


def points(area: PlotArea, x: Array, y: Array, kind: str) -> str:
    """Return points as dots."""
    dots = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(area.x_px(x), area.y_px(y), strict=True))
    return f'<path class="dots {kind}" d="{dots}"/>'


def runs(known: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the first index of every run of True, and the index after the run."""
    edges = np.flatnonzero(np.diff(np.concatenate(([0], known.astype(np.int8), [0]))))
    return [(int(start), int(end)) for start, end in edges.reshape(-1, 2)]


def column_extremes(
    area: PlotArea, x: Array, low: Array, high: Array
) -> tuple[Array, Array, Array]:
    """Return x, minimum of `low` and maximum of `high` in every pixel column, NaN if empty."""
    column = np.clip((area.x_px(x) - area.left).astype(np.int64), 0, area.columns - 1)
    lowest, highest = np.full(area.columns, np.inf), np.full(area.columns, -np.inf)
    known = np.isfinite(low) & np.isfinite(high)
    np.minimum.at(lowest, column[known], low[known])
    np.maximum.at(highest, column[known], high[known])
    empty = lowest > highest
    lowest[empty] = highest[empty] = np.nan
    span = area.x[1] - area.x[0]
    centers = area.x[0] + (np.arange(area.columns) + 0.5) / area.columns * span
    return centers, lowest, highest
