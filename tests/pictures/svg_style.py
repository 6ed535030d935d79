"""Colours and fonts of the generated drawings, in two themes, as in docs/drawings."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

LIGHT = """
.page { fill: #ffffff; } .grid { stroke: #d1d5db; } .axis { stroke: #6b7280; }
.blue { stroke: #1a73e8; } .orange { stroke: #c25a00; } .gray { stroke: #6b7280; }
.blue-fill { fill: #1a73e8; } .joint { fill: #ffffff; stroke: #1f2937; }
text { fill: #1f2937; } .soft { fill: #4b5563; }
.blue-text { fill: #1a63c8; } .orange-text { fill: #b85600; }
"""
DARK = """
.page { fill: #1e2129; } .grid { stroke: #4b5563; } .axis { stroke: #9ca3af; }
.blue { stroke: #7fb2ff; } .orange { stroke: #f0964a; } .gray { stroke: #9ca3af; }
.blue-fill { fill: #7fb2ff; } .joint { fill: #1e2129; stroke: #e5e7eb; }
text { fill: #e5e7eb; } .soft { fill: #c3c9d2; }
.blue-text { fill: #7fb2ff; } .orange-text { fill: #f0964a; }
"""
BOTH = """
text { font-family: system-ui, "Segoe UI", Helvetica, Arial, sans-serif; font-size: 18px; }
.soft { font-size: 16px; }
.strong { font-weight: 600; } .middle { text-anchor: middle; } .right { text-anchor: end; }
.line { fill: none; stroke-width: 3; stroke-linejoin: round; stroke-linecap: round; }
.dashed { stroke-dasharray: 7 6; } .grid { stroke-width: 1; } .axis { stroke-width: 1.5; }
"""


def document(
    size: tuple[int, int], title: str, description: str, body: Iterable[str], style: str = ""
) -> str:
    """Return an SVG document with title and description, in a light and a dark theme."""
    width, height = size
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}"'
        f' height="{height}" role="img" aria-labelledby="title description">\n'
        f'<title id="title">{title}</title>\n<desc id="description">{description}</desc>\n'
        f"<style>{LIGHT}{BOTH}{style}@media (prefers-color-scheme: dark) {{{DARK}}}</style>\n"
        f'<rect class="page" width="{width}" height="{height}" rx="8"/>\n'
        + "\n".join(body)
        + "\n</svg>\n"
    )


def text(x: float, y: float, words: str, kind: str = "soft") -> str:
    """Return a text element."""
    return f'<text class="{kind}" x="{x:g}" y="{y:g}">{words}</text>'


def points(pairs: Iterable[tuple[float, float]]) -> str:
    """Return the points of a polyline."""
    return " ".join(f"{x:.1f},{y:.1f}" for x, y in pairs)
