"""The readable part of a table with faults, for checks that compare values with each other."""

from __future__ import annotations

import json
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, TypeAdapter, ValidationError

from jointfit_daemon.config._fault_messages import Fault, join
from jointfit_daemon.config._syntax import UNREADABLE
from jointfit_daemon.driver import Settings
from jointfit_daemon.nearest_name import nearest_key

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence

Model = TypeVar("Model", bound=BaseModel)
_Locations = list[tuple[int | str, ...]]


def readable_part(table: Mapping[str, Any], model: type[Model], wrong: _Locations) -> Model:
    """Return `table` as a model without validation.

    Parameters
    ----------
    table
        The table. Keys that `model` refuses are omitted from the result.
    model
        Model of the table.
    wrong
        Locations of the faults in the table, as returned by pydantic.

    Returns
    -------
    Model
        Model whose unreadable keys are None: missing required keys, keys that are probably
        misspelled, and keys with unreadable values. In a faulty array of texts, every value is
        converted to a text.
    """
    fields = model.model_fields
    unknown = table.keys() - fields.keys()
    misspelled = {nearest_key(name, fields) for name in unknown} - table.keys()
    values: dict[str, Any] = {}
    for name, field in fields.items():
        if name in table:
            inside = [place[1:] for place in wrong if place[:1] == (name,)]
            values[name] = _readable(table[name], field.annotation, inside)
        elif field.is_required() or name in misspelled:
            values[name] = None
        else:
            values[name] = field.get_default(call_default_factory=True)
    if model.model_config.get("extra") == "allow":
        values |= {name: value for name, value in table.items() if name not in values}
    return model.model_construct(values.keys() & table.keys(), **values)


def _readable(value: Any, annotation: Any, wrong: _Locations) -> Any:
    """Return the readable part of `value`; None if no part is readable."""
    if isinstance(value, dict) and get_origin(annotation) is tuple:
        value = [value]  # some drivers accept one table instead of an array
    if not wrong:
        return _valid(value, annotation)
    if isinstance(value, dict) and UNREADABLE in value:
        return None

    choices = [annotation, *get_args(annotation)]  # the X of X | None
    for choice in choices:
        if isinstance(choice, type) and issubclass(choice, BaseModel) and isinstance(value, dict):
            return readable_part(value, choice, wrong)
        arguments = get_args(choice)
        if get_origin(choice) is dict and isinstance(value, dict):
            parts = _below(wrong)
            return {
                key: _readable(inner, arguments[1], parts.get(key, []))
                for key, inner in value.items()
            }
        if get_origin(choice) is tuple and arguments[1:] == (...,) and isinstance(value, list):
            return _elements(value, arguments[0], wrong)
    return None


def _valid(value: Any, annotation: Any) -> Any:
    """Return a value that has no faults of its own; None otherwise."""
    try:
        return _adapter(annotation).validate_json(json.dumps(value, default=str), strict=True)
    except ValidationError:
        return None  # pydantic did not report this fault, because another key failed first


@cache
def _adapter(annotation: Any) -> TypeAdapter[Any]:
    return TypeAdapter(annotation)


def _below(wrong: _Locations) -> dict[int | str, _Locations]:
    below: dict[int | str, _Locations] = {}
    for place in wrong:
        below.setdefault(place[0] if place else "", []).append(place[1:])
    return below


def _elements(values: Sequence[Any], kind: Any, wrong: _Locations) -> tuple[Any, ...] | None:
    """Return the readable elements of an array; None if a text array contains tables or arrays."""
    if kind is not str:
        parts = _below(wrong)
        return tuple(_readable(value, kind, parts.get(at, [])) for at, value in enumerate(values))
    if any(isinstance(value, (list, dict)) for value in values):
        return None
    return tuple(map(str, values))


def contradictions(settings: BaseModel, key: str) -> Iterator[Fault]:
    """Yield the contradictions between values of `settings`, and between values of inner tables.

    Parameters
    ----------
    settings
        A table, in which unreadable values are None.
    key
        Path of the table.
    """
    for name, value in settings:
        if isinstance(value, BaseModel):
            yield from contradictions(value, join(key, (name,)))
        if isinstance(value, tuple):
            for at, inner in enumerate(value):
                if isinstance(inner, BaseModel):
                    yield from contradictions(inner, join(key, (name, at)))
    if isinstance(settings, Settings):
        for name, text in settings.contradictions():
            value = getattr(settings, name, None)
            shown = () if value is None or isinstance(value, (BaseModel, dict)) else (value,)
            yield Fault(join(key, (name,)) if name else key, text, *shown)
