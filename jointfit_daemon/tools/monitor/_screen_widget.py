"""Textual widget that shows lines and redraws only the cells that have changed.

Over ssh, every redrawn cell costs bytes. A full screen needs kilobytes, and a changed digit needs a
few bytes.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rich.segment import Segment
from rich.style import Style as RichStyle
from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget
from typing_extensions import override

if TYPE_CHECKING:
    from collections.abc import Callable

    from textual.events import Key

    from jointfit_daemon.tools.monitor._text_lines import Line, Style

_STYLES: dict[Style, RichStyle] = {
    "": RichStyle(),
    "strong": RichStyle(bold=True),
    "muted": RichStyle(dim=True),
    "good": RichStyle(color="green"),
    "warning": RichStyle(color="yellow", bold=True),
    "error": RichStyle(color="red", bold=True),
    "imu": RichStyle(color="cyan"),
    "value": RichStyle(color="cyan", bold=True),
    "optical": RichStyle(color="magenta"),
    "chosen": RichStyle(reverse=True),
}
"""Colours of the styles. They are from the terminal's own palette, so they match its background."""
_Cell = tuple[str, "RichStyle | None"]


class ScreenWidget(Widget):
    """Widget that shows the lines of a screen and passes every key to `press`."""

    can_focus = True

    def __init__(self, press: Callable[[str], None]) -> None:
        super().__init__()
        self._press = press
        self._lines: list[Line] = []
        self._strips: list[Strip] = []
        self.redrawn = 0
        """Number of updates that changed at least one cell."""

    def show(self, lines: list[Line]) -> None:
        """Show lines; each line has the width of the widget."""
        if lines == self._lines:
            return

        regions = []
        for row, line in enumerate(lines):
            if row < len(self._lines) and self._lines[row] == line:
                continue
            strip = _strip(line)
            old = self._strips[row] if row < len(self._strips) else None
            regions.append(_changed_region(old, strip, row))
            self._strips[row : row + 1] = [strip]

        if len(lines) < len(self._strips):
            del self._strips[len(lines) :]
        self._lines = lines
        self.redrawn += 1
        self.refresh(*[region for region in regions if region])

    def on_key(self, event: Key) -> None:
        """Pass a key to `press` before Textual processes the key."""
        event.stop()
        printable = event.character is not None and event.is_printable
        self._press(str(event.character) if printable else event.key)

    @override
    def render_line(self, y: int) -> Strip:
        """Return one line of the screen for Textual."""
        if y < len(self._strips):
            return self._strips[y]
        return Strip.blank(self.size.width)


def _strip(line: Line) -> Strip:
    segments = [Segment(text, _STYLES[style]) for text, style in line.spans if text]
    return Strip(segments, line.width)


def _changed_region(old: Strip | None, new: Strip, row: int) -> Region:
    """Return the smallest region of a row that contains all changed cells."""
    if old is None or old.cell_length != new.cell_length:
        return Region(0, row, new.cell_length, 1)
    before, after = _cells(old), _cells(new)
    changed = [k for k, pair in enumerate(zip(before, after, strict=True)) if pair[0] != pair[1]]
    if not changed:
        return Region()
    return Region(changed[0], row, changed[-1] - changed[0] + 1, 1)


def _cells(strip: Strip) -> list[_Cell]:
    """Return character and style of every cell; the second cell of a wide character is empty."""
    cells: list[_Cell] = []
    for text, style, _ in strip:
        for part in Segment(text, style).split_cells(0)[1:]:
            for character in part.text:
                width = Segment(character).cell_length
                if width == 0 and cells:  # a combining mark belongs to the previous cell
                    cells[-1] = (cells[-1][0] + character, style)
                else:
                    cells += [(character, style), *[("", style)] * (width - 1)]
    return cells[: strip.cell_length] + [("", None)] * (strip.cell_length - len(cells))
