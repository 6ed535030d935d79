"""Facts of a session in a header line of a text format, as one JSON object without blanks.

``start_unix_ns`` is the UNIX time of the instant 0 s of the file. Foreign files have no such line.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import orjson

if TYPE_CHECKING:
    from collections.abc import Mapping

HEADER_KEY = "jointfit"


def header_line(**facts: Any) -> dict[str, str]:
    """Return the header entry of some facts; facts with the value None are left out."""
    known = {key: value for key, value in facts.items() if value is not None}
    return {HEADER_KEY: orjson.dumps(known).decode()}


def header_facts(header: Mapping[str, str]) -> dict[str, Any]:
    """Return the facts of a header; empty if the line is missing, foreign or damaged."""
    try:
        found = orjson.loads(header.get(HEADER_KEY, "{}"))
    except orjson.JSONDecodeError:
        return {}
    return found if isinstance(found, dict) else {}


def start_of(facts: Mapping[str, Any]) -> int | None:
    """Return ``start_unix_ns`` of header facts; None if missing or no integer."""
    start = facts.get("start_unix_ns")
    return start if isinstance(start, int) else None
