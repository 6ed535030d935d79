"""Facts of a session in one header line of a text format, as a JSON object without blanks.

``start_unix_ns`` is the UNIX time at 0 s of the file. Files of other programs have no such line.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import orjson

if TYPE_CHECKING:
    from collections.abc import Mapping

HEADER_KEY = "jointfit"


def header_line(**facts: Any) -> dict[str, str]:
    """Return the header entry that contains some facts; facts with the value None are omitted."""
    known = {key: value for key, value in facts.items() if value is not None}
    return {HEADER_KEY: orjson.dumps(known).decode()}


def header_facts(header: Mapping[str, str]) -> dict[str, Any]:
    """Return the facts of a header; empty if the line is missing, damaged or of another program."""
    try:
        found = orjson.loads(header.get(HEADER_KEY, "{}"))
    except orjson.JSONDecodeError:
        return {}
    return found if isinstance(found, dict) else {}


def start_of(facts: Mapping[str, Any]) -> int | None:
    """Return ``start_unix_ns`` of header facts; None if it is missing or not an integer."""
    start = facts.get("start_unix_ns")
    return start if isinstance(start, int) else None
