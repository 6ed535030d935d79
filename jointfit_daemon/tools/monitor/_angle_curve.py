"""Curves of the chosen angle over the last seconds, from the sensors and from the cameras."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import TYPE_CHECKING

from jointfit_daemon.tools.monitor._dot_canvas import DotCanvas, render
from jointfit_daemon.tools.monitor._rig_view import SHOWN_S
from jointfit_daemon.tools.monitor._text_lines import Line, fit_text
from jointfit_daemon.tools.monitor._words import format_number

if TYPE_CHECKING:
    from collections.abc import Iterable

    from jointfit_daemon.tools.monitor._rig_view import AngleChoice, AngleSample, RigView

_MARGIN = 6
"""Width of the numbers at the axis, cells."""
_LONG = 66
"""Smallest width for the longest time range, cells. A narrower curve shows half of this range."""
_GAP_US = 400_000
"""Longest time between two connected points, µs."""
_LEAST_HALF_DEG = 10.0
"""Half of the smallest range of the axis, degrees."""
_LEAST_PAIRS = 20
"""Smallest number of points from which the difference from the cameras is computed."""
_PAIR_US = 60_000
"""Longest time between two angles, one from the sensors and one from the cameras, whose difference
is computed, µs."""
_Point = tuple[int, float]


def curve_lines(
    rig: RigView, choice: AngleChoice, width: int, rows: int, *, unicode: bool
) -> list[Line]:
    """Return the curve in `rows` lines with its axis, and a caption in one more line."""
    columns = max(1, width - _MARGIN)
    shown_s = SHOWN_S if columns >= _LONG else SHOWN_S / 2
    newest_us = rig.poses[-1].t_us if rig.poses else 0
    oldest_us = newest_us - shown_s * 1e6
    imu, optical = (
        _known_points(samples, choice, oldest_us) for samples in (rig.poses, rig.opticals)
    )
    values = [value for _, value in (*imu, *optical)]
    span = _angle_range(values)
    front, back = (DotCanvas(columns, rows, unicode) for _ in range(2))
    column_us = shown_s * 1e6 / front.width
    # The curve moves by whole cells. A movement by single dots would change every cell of the
    # curve.
    cell_us = column_us * front.width / columns
    newest = (math.floor(newest_us / cell_us) + 1) * (front.width // columns) - 1
    for canvas, points, every in ((front, imu, 1), (back, optical, 2)):
        _draw(canvas, points, newest, column_us, span=span, every=every)

    labels = {0: span[1], rows - 1: span[0]}
    lines = []
    for row, line in enumerate(render(front, "imu", back, "optical")):
        label = format_number(labels[row], 0, "°" if unicode else "") if row in labels else ""
        lines.append(Line.of(f"{fit_text(label, _MARGIN - 1, right=True)} ", "muted") + line)
    return [*lines, _caption(imu, optical, shown_s, width, unicode=unicode)]


def _known_points(
    samples: Iterable[AngleSample], choice: AngleChoice, oldest_us: float
) -> list[_Point]:
    return [
        (sample.t_us, value)
        for sample in samples
        if sample.t_us >= oldest_us
        and (value := sample.angles.get(choice)) is not None
        and math.isfinite(value)
    ]


def _angle_range(values: list[float]) -> tuple[float, float]:
    """Return a range of at least 20° that ends at multiples of 10°."""
    if not values:
        return -10.0, 90.0
    middle = (min(values) + max(values)) / 2
    half = max(_LEAST_HALF_DEG, (max(values) - min(values)) / 2 + 1)
    return math.floor((middle - half) / 10) * 10.0, math.ceil((middle + half) / 10) * 10.0


def _draw(
    canvas: DotCanvas,
    points: list[_Point],
    newest: int,
    column_us: float,
    *,
    span: tuple[float, float],
    every: int,
) -> None:
    """Draw points; `newest` is the number of dot columns from UNIX time 0 to the last column.

    `column_us` is the duration of a dot column, `span` the angles at the lower and upper edge. Only
    one of `every` dot columns is drawn.
    """
    low, high = span

    def dot(point: _Point) -> tuple[int, int]:
        t_us, value = point
        x = canvas.width - 1 - (newest - math.floor(t_us / column_us))
        return x, round((high - value) / (high - low) * (canvas.height - 1))

    for before, after in pairwise(points):
        start, end = dot(before), dot(after)
        if end[0] % every == 0:
            if after[0] - before[0] <= _GAP_US:
                canvas.line(start, end)
            else:
                canvas.plot(*end)


def _caption(
    imu: list[_Point], optical: list[_Point], shown_s: float, width: int, *, unicode: bool
) -> Line:
    if not imu:
        return Line.of(f"No known angle in the last {shown_s:g} s.", "muted")

    values = [value for _, value in imu]
    span = f"{format_number(min(values), 0, '°')} to {format_number(max(values), 0, '°')}"
    line = Line.of(f"{shown_s:g} s: {span}  ", "muted")
    if not optical:
        return line

    line = line.add("─ IMUs  " if unicode else "* IMUs  ", "imu")
    line = line.add("· cameras" if unicode else ". cameras", "optical")

    difference = _difference(imu, optical)
    if difference is None:
        return line
    longer = line.add(f" ({format_number(difference, 1, '°')} RMS)", "muted")
    return longer if longer.width <= width else line


def _difference(imu: list[_Point], optical: list[_Point]) -> float | None:
    """Return the RMS difference between simultaneous angles of sensors and cameras, degrees.

    The result is None with fewer than `_LEAST_PAIRS` simultaneous angles.
    """
    squares, at = [], 0
    for t_us, value in imu:
        while at + 1 < len(optical) and abs(optical[at + 1][0] - t_us) <= abs(
            optical[at][0] - t_us
        ):
            at += 1
        if abs(optical[at][0] - t_us) <= _PAIR_US:
            squares.append((value - optical[at][1]) ** 2)
    if len(squares) < _LEAST_PAIRS:
        return None
    return math.sqrt(sum(squares) / len(squares))
