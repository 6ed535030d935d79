"""Drawing of the growth experiments from stored results, as SVG in two colour themes."""

from __future__ import annotations

import re
from math import log10
from typing import TYPE_CHECKING

from bench.framework import storage

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    Points = list[tuple[float, float]]

CURVES = (
    ("growth-sensors", "sensors of a segment", "blue"),
    ("growth-segments", "segments", "orange"),
    ("growth-markers", "markers of a segment", "green"),
)
"""Experiment, label and color of each curve of CPU time."""
FLAT_CURVES = (
    ("growth-run-time", "frames of a run (instructions)", "blue"),
    ("growth-recordings", "recordings of a batch (CPU time)", "orange"),
)
"""Experiment, label and color of each curve of the cost of one frame or recording."""
WIDTH, HEIGHT = 760, 720
LEFT, RIGHT = 92.0, 736.0
COST_TOP, COST_BOTTOM = 96.0, 356.0
SIZES, COSTS_US = (1.0, 300.0), (50.0, 5000.0)
FLAT_TOP, FLAT_BOTTOM = 516.0, 656.0
COUNTS, RATIOS = (1.0, 1e6), (0.8, 1.25)
_COUNT_TICKS = {1: "1", 100: "100", 10_000: "10⁴", 1_000_000: "10⁶"}
_RATIO_TICKS = (0.8, 0.9, 1.0, 1.1, 1.25)
_SIZE_TICKS = (1, 3, 10, 30, 100, 300)
_COST_TICKS_US = (100, 300, 1000, 3000)
_STYLE = """
.page { fill: #ffffff; } .grid { stroke: #d1d5db; stroke-width: 1; } text { fill: #1f2937; }
.soft { fill: #4b5563; font-size: 16px; } .right { text-anchor: end; }
.middle { text-anchor: middle; }
.blue { color: #1a63c8; } .orange { color: #b85600; } .green { color: #0f766e; }
.line { fill: none; stroke: currentColor; stroke-width: 3; } .dot, .name { fill: currentColor; }
text { font-family: system-ui, "Segoe UI", Helvetica, Arial, sans-serif; font-size: 18px; }
@media (prefers-color-scheme: dark) {
.page { fill: #1e2129; } .grid { stroke: #4b5563; } text { fill: #e5e7eb; } .soft { fill: #c3c9d2; }
.blue { color: #7fb2ff; } .orange { color: #f0964a; } .green { color: #5eead4; } }
.name, .dot { fill: currentColor; }
"""
_SIZE = re.compile(r".*: (?:frame )?(\d+)")


def growth_plot() -> str:
    """Return the drawing of the stored results as SVG."""
    parts = [_text(LEFT, 34, "CPU time of a frame, µs (logarithmic axes)", "title")]
    for index, (_, label, color) in enumerate(CURVES):
        parts.append(_text(LEFT + 215 * index, 64, label, f"name {color}"))
    ticks = [(size, str(size)) for size in _SIZE_TICKS]
    parts += _axes(
        [(_cost_x(size), words) for size, words in ticks],
        [(_cost_y(cost), str(cost)) for cost in _COST_TICKS_US],
        COST_TOP,
        COST_BOTTOM,
    )
    for name, _, color in CURVES:
        parts += _curve([(_cost_x(size), _cost_y(us)) for size, us in _points(name)], color)
    parts.append(
        _text(RIGHT, COST_BOTTOM + 48, "number of sensors, segments or markers", "soft right")
    )
    return _document(parts + _flat_panel())


def _flat_panel() -> list[str]:
    """Return the panel with the cost of one frame or recording, relative to the first cost."""
    title = "Cost of one frame or recording, relative to the first"
    parts = [_text(LEFT, FLAT_TOP - 62, title, "title")]
    for index, (_, label, color) in enumerate(FLAT_CURVES):
        parts.append(_text(LEFT + 310 * index, FLAT_TOP - 32, label, f"name {color}"))

    def x(count: float) -> float:
        return _scale(count, COUNTS, (LEFT + 10, RIGHT - 20))

    def y(ratio: float) -> float:
        return _scale(ratio, RATIOS, (FLAT_BOTTOM, FLAT_TOP))

    parts += _axes(
        [(x(count), words) for count, words in _COUNT_TICKS.items()],
        [(y(ratio), str(ratio)) for ratio in _RATIO_TICKS],
        FLAT_TOP,
        FLAT_BOTTOM,
    )
    for name, _, color in FLAT_CURVES:
        points = _points(name)
        if name == "growth-recordings":  # costs of whole batches
            points = [(count, cost / count) for count, cost in points]
        first = points[0][1]
        parts += _curve([(x(count), y(cost / first)) for count, cost in points], color)
    parts.append(_text(RIGHT, FLAT_BOTTOM + 48, "number of frames or recordings", "soft right"))
    return parts


def _points(name: str) -> Points:
    """Return sizes and values of the results whose names end with a size."""
    results = storage.results_of(storage.load(name))
    return [
        (float(found[1]), result.value)
        for result in results
        if not result.name.startswith(("memory", "start"))
        and (found := _SIZE.fullmatch(result.name))
    ]


def _scale(value: float, limits: tuple[float, float], ends: tuple[float, float]) -> float:
    low, high = limits
    share = (log10(value) - log10(low)) / (log10(high) - log10(low))
    return ends[0] + share * (ends[1] - ends[0])


def _cost_x(size: float) -> float:
    return _scale(size, SIZES, (LEFT + 10, RIGHT - 20))


def _cost_y(us: float) -> float:
    return _scale(us, COSTS_US, (COST_BOTTOM, COST_TOP))


def _axes(
    across: Iterable[tuple[float, str]], up: Iterable[tuple[float, str]], top: float, bottom: float
) -> list[str]:
    parts = []
    for y, words in up:
        parts.append(f'<path class="grid" d="M{LEFT:g} {y:.1f}H{RIGHT:g}"/>')
        parts.append(_text(LEFT - 10, y + 6, words, "soft right"))
    for x, words in across:
        parts.append(f'<path class="grid" d="M{x:.1f} {top:g}V{bottom:g}"/>')
        parts.append(_text(x, bottom + 22, words, "soft middle"))
    return parts


def _curve(points: Sequence[tuple[float, float]], color: str) -> list[str]:
    line = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    dots = [f'<circle class="dot {color}" cx="{x:.1f}" cy="{y:.1f}" r="5"/>' for x, y in points]
    return [f'<path class="line {color}" d="M{line}"/>', *dots]


def _text(x: float, y: float, words: str, kind: str) -> str:
    return f'<text class="{kind}" x="{x:.1f}" y="{y:.1f}">{words}</text>'


def _document(parts: Iterable[str]) -> str:
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}"'
        f' height="{HEIGHT}" role="img" aria-labelledby="title description">\n'
        '<title id="title">Growth of the costs with size and number</title>\n'
        '<desc id="description">Above, the CPU time of a frame against the number of sensors,'
        " segments and markers. Below, the cost of one frame against the frames of a run, and of"
        " one recording against the recordings of a batch. All axes are logarithmic.</desc>\n"
        f'<style>{_STYLE}</style>\n<rect class="page" width="{WIDTH}" height="{HEIGHT}" rx="8"/>\n'
        + "\n".join(parts)
        + "\n</svg>\n"
    )
