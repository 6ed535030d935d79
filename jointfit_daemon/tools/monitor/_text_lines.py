"""Styled lines of a terminal: width in cells, cropping, wrapping, columns, and an ASCII form.

A style is a word that `_screen_widget.py` maps to a colour. Invariant: no line contains control
characters. A line from `Line.fit` has exactly the given width.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self

from rich.cells import cell_len, chop_cells, set_cell_size

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

Style = Literal[
    "", "strong", "muted", "good", "warning", "error", "imu", "value", "optical", "chosen"
]
_ASCII = {
    "±": "+-", "°": " deg", "µ": "u", "–": "-", "−": "-", "…": "...", "·": "-", "✔": "+",
    "▲": "!", "✖": "x", "●": "*", "○": "o", "▶": ">", "█": "#", "░": "-", "─": "-", "│": "|",
    "“": '"', "”": '"', "’": "'", "↑": "^", "↓": "v", "←": "<", "→": ">", "σ": "sigma",
}  # fmt: skip
"""Replacements of characters on terminals without Unicode."""


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a screen: texts with their styles."""

    spans: tuple[tuple[str, Style], ...] = ()

    @classmethod
    def of(cls, text: str, style: Style = "") -> Self:
        """Return a line with one text."""
        return cls(((text, style),))

    def add(self, text: str, style: Style = "") -> Line:
        """Return a new line with `text` appended."""
        return Line((*self.spans, (text, style)))

    def __add__(self, other: Line) -> Line:
        return Line(self.spans + other.spans)

    @property
    def text(self) -> str:
        """Return the text without styles."""
        return "".join(text for text, _ in self.spans)

    @property
    def width(self) -> int:
        """Return the number of terminal cells."""
        return cell_len(self.text)

    def fit(self, width: int) -> Line:
        """Return the line with exactly `width` cells: padded, or cropped with an ellipsis."""
        excess = self.width - width
        if excess <= 0:
            return self if excess == 0 else self.add(" " * -excess)

        spans: list[tuple[str, Style]] = []
        free = max(0, width - 1)
        for text, style in self.spans:
            part = set_cell_size(text, min(free, cell_len(text)))
            spans.append((part, style))
            free -= cell_len(part)
            if free <= 0:
                break
        return Line((*spans, ("…" if width else "", "")))

    def to_ascii(self) -> Line:
        """Return the line with ASCII characters only; the width remains equal or increases."""
        return Line(tuple((to_ascii(text), style) for text, style in self.spans))


def to_ascii(text: str) -> str:
    """Return `text` in ASCII; ``?`` replaces each cell of an unknown character."""
    if text.isascii():
        return text
    return "".join(
        each if each.isascii() else _ASCII.get(each, "?" * cell_len(each)) for each in text
    )


def fit_text(text: str, width: int, *, right: bool = False) -> str:
    """Return `text`, padded or cropped to exactly `width` cells."""
    missing = width - cell_len(text)
    if missing < 0:
        return set_cell_size(text, max(0, width - 1)) + "…"[:width]
    return " " * missing + text if right else text + " " * missing


def wrap(text: str, width: int, style: Style = "", *, indent: int = 0) -> list[Line]:
    """Return a text as lines of at most `width` cells, broken at blanks where possible.

    All lines after the first line are indented by `indent` cells.
    """
    lines: list[str] = []
    current, free = "", max(1, width)
    for word in text.split():
        pieces = chop_cells(word, max(1, width - indent)) if cell_len(word) > free else [word]
        for piece in pieces:
            needed = cell_len(piece) + (1 if current.strip() else 0)
            if current.strip() and cell_len(current) + needed > free:
                lines.append(current)
                current = " " * indent
            current += (" " if current.strip() else "") + piece

    if current.strip():
        lines.append(current)
    return [Line.of(line, style) for line in lines]


def beside(left: Sequence[Line], width: int, right: Sequence[Line], gap: int = 2) -> list[Line]:
    """Return two blocks of lines side by side; the left block has `width` cells."""
    rows = max(len(left), len(right))
    empty = Line()
    return [
        (left[row] if row < len(left) else empty).fit(width).add(" " * gap)
        + (right[row] if row < len(right) else empty)
        for row in range(rows)
    ]


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table."""

    title: str
    right: bool = False
    """Whether the cells are right-aligned, as for numbers."""


def table(
    columns: Sequence[Column], rows: Iterable[Sequence[tuple[str, Style]]], width: int
) -> list[Line]:
    """Return a table; the width of its last column is the remaining width."""
    rows = [*rows]
    titles: list[tuple[str, Style]] = [(column.title, "muted") for column in columns]
    every = [titles, *rows]
    widths = [max(cell_len(row[k][0]) for row in every) for k in range(len(columns))]

    lines = []
    for row in every:
        spans = tuple(
            (fit_text(text, cells, right=column.right) + "  ", style)
            for (text, style), cells, column in zip(row, widths, columns, strict=True)
        )
        text, style = row[-1]
        line = Line((*spans[:-1], (text, style)))
        lines.append(line.fit(width) if line.width > width else line)
    return lines
