"""Keys and values as TOML text.

Invariant: `tomllib` reads the text of a value as that value.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def toml_key(name: str) -> str:
    """Return a key of TOML, in quotes if necessary."""
    return name if _BARE_KEY.fullmatch(name) else toml_value(name)


def toml_value(value: Any, *, hexadecimal: bool = False) -> str:
    """Return a value of TOML, a mapping as an inline table without its keys of value None.

    Parameters
    ----------
    value
        Text, number, Boolean, list, tuple or mapping.
    hexadecimal
        Whether integers are written as ``0x1a``.
    """
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int) and hexadecimal:
        return f"{value:#x}"
    if isinstance(value, str):
        # A string of JSON is one of TOML, except for DEL.
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
