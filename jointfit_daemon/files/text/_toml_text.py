"""Keys and values as TOML text.

Invariant: `tomllib` converts the text of a value back to the same value.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def toml_key(name: str) -> str:
    """Return the TOML text of a key, in quotes if necessary."""
    return name if _BARE_KEY.fullmatch(name) else toml_value(name)


def toml_value(value: Any, *, hexadecimal: bool = False) -> str:
    """Return the TOML text of a value. Mappings become inline tables; None values are omitted.

    Parameters
    ----------
    value
        Text, number, Boolean, list, tuple or mapping.
    hexadecimal
        Whether integers are written as ``0x1a``. Integers in lists are always decimal.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int) and hexadecimal:
        return f"{value:#x}"
    if isinstance(value, str):
        # A JSON string is also a TOML string, except for the character DEL.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, Mapping):
        pairs = (
            f"{toml_key(key)} = {toml_value(inner, hexadecimal=hexadecimal)}"
            for key, inner in value.items()
            if inner is not None
        )
        return f"{{ {', '.join(pairs)} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return repr(value)
