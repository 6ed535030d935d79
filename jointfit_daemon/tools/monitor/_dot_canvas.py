"""A canvas of dots for curves and stick figures, in Braille patterns or ASCII characters.

A Braille cell has two columns and four rows of dots, so the dots have nearly equal distances in
both directions. An ASCII cell is one dot, whose height is about twice its width.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from jointfit_daemon.tools.monitor._text_lines import Line

if TYPE_CHECKING:
    from jointfit_daemon.tools.monitor._text_lines import Style

_BRAILLE = 0x2800
_BITS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))
"""Bit of a dot in a Unicode Braille pattern, by column and row."""


@dataclass(slots=True)
class DotCanvas:
    """Canvas of dots with `columns` by `rows` cells; the origin is the upper left corner."""

    columns: int
    rows: int
    unicode: bool = True
    _masks: list[list[int]] = field(init=False)

    def __post_init__(self) -> None:
        self._masks = [[0] * self.columns for _ in range(self.rows)]

    @property
    def width(self) -> int:
        """Return the number of dots in a row."""
        return self.columns * (2 if self.unicode else 1)

    @property
    def height(self) -> int:
        """Return the number of dots in a column."""
        return self.rows * (4 if self.unicode else 1)

    @property
    def aspect(self) -> float:
        """Return the ratio of height to width of a dot on the screen."""
        return 1.0 if self.unicode else 2.0

    def plot(self, x: int, y: int) -> None:
        """Set a dot; dots outside of the canvas are ignored."""
        if not (0 <= x < self.width and 0 <= y < self.height):
            return
        if self.unicode:
            self._masks[y // 4][x // 2] |= _BITS[x % 2][y % 4]
        else:
            self._masks[y][x] = 1

    def line(self, start: tuple[int, int], end: tuple[int, int], *, every: int = 1) -> None:
        """Draw a straight line; `every` is the distance of the drawn dots, in dots."""
        (x0, y0), (x1, y1) = start, end
        steps = max(abs(x1 - x0), abs(y1 - y0), 1)
        if steps > 4 * (self.width + self.height):
            return
        for k in range(0, steps + 1, every):
            self.plot(round(x0 + (x1 - x0) * k / steps), round(y0 + (y1 - y0) * k / steps))

    def mask(self, column: int, row: int) -> int:
        """Return the dots of a cell as bits; 0 is an empty cell."""
        return self._masks[row][column]


def render(front: DotCanvas, style: Style, back: DotCanvas, back_style: Style) -> list[Line]:
    """Return lines that show two canvases of the same size on top of each other.

    A cell has the style of the front canvas if the front canvas has a dot in the cell.
    """
    lines = []
    for row in range(front.rows):
        spans: list[tuple[str, Style]] = []
        for column in range(front.columns):
            above, below = front.mask(column, row), back.mask(column, row)
            if front.unicode:
                mask = above | below
                character = chr(_BRAILLE + mask) if mask else " "
            else:
                character = "*" if above else "." if below else " "

            # Adjacent cells of the same style form one span, which includes blank cells.
            chosen: Style = style if above else back_style if below else ""
            if spans and (spans[-1][1] == chosen or character == " "):
                spans[-1] = (spans[-1][0] + character, spans[-1][1])
            else:
                spans.append((character, chosen))
        lines.append(Line(tuple(spans)))
    return lines
