"""Faults of rig.toml and their messages: key, value, expectation, and nearest valid name.

Invariant: one `ConfigError` lists all faults.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticUndefined

from jointfit_daemon.driver import CONTRADICTION, CanBusError
from jointfit_daemon.nearest_name import nearest_key, nearest_name

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from pydantic_core import ErrorDetails

_LONGEST_VALUE = 60
"""Longest value in a message, characters."""
_NO_VALUE = object()
SECRET = re.compile(r"passw|passphrase|secret|token|api_?key|private_?key|request_?key")
"""Names of keys whose values must not appear in a message."""


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of a rig.toml."""

    key: str
    """Path of the key, such as ``imu[S1].rate_hz``."""
    expected: str
    """Description of a valid value, or of the fault if no valid value can be described."""
    value: Any = _NO_VALUE
    near: str | None = None
    """Valid name that is most similar to the wrong name; None without a similar name."""

    @property
    def has_value(self) -> bool:
        """Whether the fault concerns an existing value; False for a missing key."""
        return self.value is not _NO_VALUE

    def as_dict(self) -> dict[str, Any]:
        """Return the attributes for JSON; ``value`` exists only if the fault has a value."""
        fields = {"key": self.key, "expected": self.expected, "near": self.near}
        return fields | {"value": self.value} if self.has_value else fields

    def text(self) -> str:
        """Return the message as one line."""
        written = isinstance(self.value, bool)
        value = str(self.value).lower() if written else repr(self.value)  # TOML: true, false
        if len(value) > _LONGEST_VALUE:
            value = f"{value[:_LONGEST_VALUE]}…"
        shown = f" = {value}" if self.has_value else ""
        hint = f"; did you mean {self.near!r}?" if self.near else ""
        return f"{self.key}{shown}: {self.expected}{hint}"


class ConfigError(Exception):
    """A rig.toml cannot be used; the message lists all faults.

    Parameters
    ----------
    source
        Name of the file.
    faults
        All faults; at least one.
    """

    def __init__(self, source: str, faults: Sequence[Fault]) -> None:
        count = f"{len(faults)} fault{'s' if len(faults) > 1 else ''}"
        super().__init__("\n  ".join([f"{source}: {count}", *[fault.text() for fault in faults]]))
        self.source = source
        self.faults = tuple(faults)


def faults_of(error: ValidationError, model: type[BaseModel], key: str) -> list[Fault]:
    """Return the faults that pydantic found in the table at `key`.

    Contradictions are omitted, because `_readable.contradictions` finds all of them. Faults of a
    bus are omitted, because they are reported for the table of the bus.
    """
    return [
        _fault(detail, model, key)
        for detail in error.errors(include_url=False)
        if detail["type"] != CONTRADICTION
        and not isinstance(detail.get("ctx", {}).get("error"), CanBusError)
    ]


def _fault(detail: ErrorDetails, model: type[BaseModel], key: str) -> Fault:
    loc = detail["loc"]
    path = join(key, loc)
    owner = _model_at(model, loc[:-1])
    fields = owner.model_fields if owner is not None else {}
    match detail["type"]:
        case "extra_forbidden" if SECRET.search(str(loc[-1]).lower()):
            files = [name for name in fields if name.endswith("_file")]
            files = [f"{loc[-1]}_file"] if f"{loc[-1]}_file" in files else files
            instead = f" and name it: {' or '.join(files)}" if files else ""
            return Fault(
                path,
                f"a secret does not belong here: others can read rig.toml. Put it into a "
                f"file{instead}",
            )
        case "extra_forbidden":
            known = f"unknown key; known here: {', '.join(fields)}"
            return Fault(path, known, detail["input"], nearest_key(loc[-1], fields))
        case "missing":
            about = _description_of(fields, loc[-1])
            return Fault(path, f"missing; {about}" if about else "missing: expected a value")
        case "literal_error":
            choices = str(detail["ctx"]["expected"])
            words = choices.replace("'", "").replace(" or ", ", ").split(", ")
            about = _description_of(fields, loc[-1])
            expected = f"expected {choices}" + (f" ({about})" if about else "")
            return Fault(path, expected, detail["input"], nearest_name(detail["input"], words))
        case "model_type" | "model_attributes_type" | "dict_type":
            return Fault(path, f"expected a table{_example(model, loc)}", detail["input"])
        case _:
            name = next((part for part in reversed(loc) if part in fields), loc[-1] if loc else "")
            why = f" ({about})" if (about := _description_of(fields, name)) else ""
            text = detail["msg"].removeprefix("Value error, ").removeprefix("Input ")
            expected = f"{text[:1].lower()}{text[1:]}{why}"
            # A check of a whole table names the keys; the printed table itself would be truncated.
            whole = detail["type"] == "value_error" and isinstance(detail["input"], dict)
            return Fault(path, expected, _NO_VALUE if whole else detail["input"])


def _example(model: type[BaseModel], loc: Sequence[int | str]) -> str:
    """Return an example of the table at `loc`, from the first key of its model."""
    inner = _model_at(model, loc)
    if inner is None or not inner.model_fields:
        return ""
    name, field = next(iter(inner.model_fields.items()))
    value = (field.examples or [field.default])[0]
    shown = '"…"' if value is None or value is PydanticUndefined else value
    return f", such as {loc[-1]} = {{ {name} = {shown} }}" if loc else ""


def join(key: str, loc: Sequence[int | str]) -> str:
    """Return the path of `loc` below `key`: names after dots, positions in brackets."""
    return key + "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in loc)


def _description_of(fields: Mapping[str, Any], name: object) -> str:
    field = fields.get(str(name))
    return str(field.description or "") if field is not None else ""


def _model_at(model: type[BaseModel], loc: Sequence[int | str]) -> type[BaseModel] | None:
    """Return the model whose fields are the keys at `loc`; None if no model is at `loc`."""
    here: type[BaseModel] | None = model
    for part in loc:
        if isinstance(part, int):
            continue  # an element of an array has the model of the array
        field = here.model_fields.get(str(part)) if here is not None else None
        here = _model_in(field.annotation) if field is not None else None
    return here


def _model_in(annotation: Any) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for inner in getattr(annotation, "__args__", ()):
        if (found := _model_in(inner)) is not None:
            return found
    return None
