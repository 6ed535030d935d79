"""Numbers with a height of three lines, for the angle of the chosen joint."""

from __future__ import annotations

_GLYPHS = {
    "0": ("╭─╮", "│ │", "╰─╯"), "1": (" ╷ ", " │ ", " ╵ "), "2": ("╶─╮", "╭─╯", "╰─╴"),
    "3": ("╶─╮", " ─┤", "╶─╯"), "4": ("╷ ╷", "╰─┤", "  ╵"), "5": ("╭─╴", "╰─╮", "╶─╯"),
    "6": ("╭─╴", "├─╮", "╰─╯"), "7": ("╶─╮", "  │", "  ╵"), "8": ("╭─╮", "├─┤", "╰─╯"),
    "9": ("╭─╮", "╰─┤", "╶─╯"), "−": ("   ", "╶─╴", "   "), ".": (" ", " ", "."),
    "°": ("°", " ", " "), "–": ("   ", "╶─╴", "   "),
}  # fmt: skip
_ASCII_GLYPHS = {
    "0": (" _ ", "| |", "|_|"), "1": ("   ", "  |", "  |"), "2": (" _ ", " _|", "|_ "),
    "3": (" _ ", " _|", " _|"), "4": ("   ", "|_|", "  |"), "5": (" _ ", "|_ ", " _|"),
    "6": (" _ ", "|_ ", "|_|"), "7": (" _ ", "  |", "  |"), "8": (" _ ", "|_|", "|_|"),
    "9": (" _ ", "|_|", " _|"), "−": ("   ", " _ ", "   "), ".": (" ", " ", "."),
    "°": (" ", " ", " "), "–": ("   ", " _ ", "   "),
}  # fmt: skip


def big_digits(text: str, *, unicode: bool = True) -> list[str]:
    """Return three lines of digits for a number such as ``−12.3°``."""
    glyphs = _GLYPHS if unicode else _ASCII_GLYPHS
    shown = [glyphs[character] for character in text if character in glyphs]
    return [" ".join(glyph[row] for glyph in shown) for row in range(3)]
