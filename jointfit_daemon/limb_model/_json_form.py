"""JSON form of calibrations and models: dicts, lists, numbers, strings and None."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any


def fields_form(record: Any) -> dict[str, Any]:
    """Return the fields that the constructor of a dataclass takes, each in its JSON form."""
    return {f.name: json_form(getattr(record, f.name)) for f in fields(record) if f.init}


def json_form(value: Any) -> Any:
    """Return the JSON form of a value, from ``to_dict()`` if defined; tuples become lists."""
    if hasattr(value, "to_dict"):
        return value.to_dict()
    if is_dataclass(value):
        return fields_form(value)
    if isinstance(value, Mapping):
        return {key: json_form(item) for key, item in value.items()}
    return [json_form(item) for item in value] if isinstance(value, list | tuple) else value
