"""Lists of names and words in messages.

Invariant: a list contains every name, or the number of omitted names.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence


def list_names(names: Sequence[str], most: int = 8) -> str:
    """Return names as ``a, b and 3 more``, with at most `most` of them; empty without names."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def join_words(words: Iterable[str]) -> str:
    """Return one or more words as ``a``, ``a and b`` or ``a, b and c``."""
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
