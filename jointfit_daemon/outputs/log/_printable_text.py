"""Escaping of control characters in text from devices, servers, adapters and clients.

Invariant: `printable` returns one line of limited length without control characters.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from typing_extensions import override

LONGEST = 2000
"""Longest text, characters. The longest message of the daemon has about 600 characters."""
_DEEPEST = 4
"""Largest nesting depth of data. A value at a deeper level is converted to text."""


def printable(text: str, longest: int = LONGEST) -> str:
    r"""Return `text` on one line, with control and format characters escaped (``\n``, ``\x1b``).

    A text longer than `longest` characters is truncated and ends in ``…``.
    """
    if len(text) > longest:
        text = text[: longest - 1] + "…"
    if text.isprintable():
        return text
    return "".join(
        each if each.isprintable() else each.encode("unicode_escape").decode() for each in text
    )


def printable_data(data: Any, depth: int = 0) -> Any:
    """Return `data` in which `printable` was applied to each text, including keys."""
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
    """A log record in which every line after the first begins with a bar.

    No line can therefore imitate another log entry.

    The class is installed by ``logging.setLogRecordFactory``, so all handlers use it.
    """

    @override
    def getMessage(self) -> str:
        """Return the message with escaped control characters and a bar before each further line."""
        lines = super().getMessage().splitlines()
        return "\n  | ".join(map(printable, lines))
