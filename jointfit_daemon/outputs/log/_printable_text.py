"""Text that devices, servers, adapters and clients send, made fit for a log, an event or a field.

Invariant: what ``printable`` returns is one line without control characters and of bounded length.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from typing_extensions import override

LONGEST = 2000
"""Characters of a text; the longest message of ours has about 600."""
_DEEPEST = 4


def printable(text: str, longest: int = LONGEST) -> str:
    r"""Return `text` on one line: control and format characters as escapes (``\n``, ``\x1b``).

    A text longer than `longest` characters ends in ``…``.
    """
    if len(text) > longest:
        text = text[: longest - 1] + "…"
    if text.isprintable():  # as nearly always
        return text
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )


def printable_data(data: Any, depth: int = 0) -> Any:
    """Return `data` with every text in it printable; what is nested too deeply as text."""
    if isinstance(data, str):
        return printable(data)
    if isinstance(data, Mapping | list | tuple) and depth >= _DEEPEST:
        return printable(repr(data))
    if isinstance(data, Mapping):
        return {
            printable(key) if isinstance(key, str) else key: printable_data(value, depth + 1)
            for key, value in data.items()
        }
    if isinstance(data, list | tuple):
        return [printable_data(value, depth + 1) for value in data]
    return data


class PrintableRecord(logging.LogRecord):
    """A record whose message cannot pass for several: further lines are indented behind a bar.

    Installed by ``logging.setLogRecordFactory``, so that it holds for every handler.
    """

    @override
    def getMessage(self) -> str:
        """Return the message, its lines printable."""
        lines = super().getMessage().splitlines()
        return "\n  | ".join(map(printable, lines))
