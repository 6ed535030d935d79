"""Chain models in TOML (for editing) and JSON (for programs), with the same keys.

Files use metres, radians and z up, in the same way as the program. Keys with a default may be
omitted. All errors of a file are reported together. docs/kinematics.md describes the format.
"""

from __future__ import annotations

import json
from itertools import compress
from typing import TYPE_CHECKING, Any, get_args

from jointfit_daemon.files.models._units import require_metres
from jointfit_daemon.files.text import MalformedFileError, read_json, read_toml, toml_value
from jointfit_daemon.kinematics.chains import (
    ChainModel,
    InvalidChainModelError,
    Joint,
    JointKind,
    Marker,
    Segment,
)
from jointfit_daemon.nearest_name import did_you_mean

if TYPE_CHECKING:
    from pathlib import Path

_AXES = "xyz"
_KEYS = {
    "model": {"name", "segment", "marker"},
    "segment": {
        "name",
        "parent",
        "joint",
        "center_in_parent",
        "center",
        "axis",
        "rest",
        "limits",
        "path",
    },
    "marker": {"name", "segment", "position", "weight", "locked"},
}
_LENGTHS = {"center_in_parent": 3, "center": 3, "axis": 3, "rest": 4, "limits": 2, "position": 3}
_SAMPLE = 8


def read_model(path: Path) -> ChainModel:
    """Return the chain model of a ``.toml`` or ``.json`` file.

    Raises
    ------
    MalformedFileError
        The file does not exist or is damaged, has unknown keys, values of the wrong type or lengths
        that cannot be metres, or its segments do not form a chain.
    """
    kind = path.suffix.lower()
    if kind not in {".toml", ".json"}:
        raise MalformedFileError(f"{path}: no chain model: expected a .osim, .toml or .json file")
    data = read_json(path) if kind == ".json" else read_toml(path)
    return model_of(data, str(path), path.stem)


def model_of(data: Any, source: str, name: str = "chain") -> ChainModel:
    """Return the chain model of parsed data; `as_data` is the inverse.

    Parameters
    ----------
    data
        Content of a file, or a table of another file.
    source
        Name of the source in error messages.
    name
        Name of the model if the data contain no name.

    Raises
    ------
    MalformedFileError
        For the reasons given at `read_model`.
    """
    wrong = _wrong(data)
    if wrong:
        raise MalformedFileError(f"{source}: {'; '.join(wrong)}")
    try:
        model = ChainModel(
            tuple(_segment(s) for s in data.get("segment", ())),
            tuple(_marker(m) for m in data.get("marker", ())),
            data.get("name", name),
        )
    except InvalidChainModelError as error:
        raise MalformedFileError(f"{source}: {error}") from error

    return require_metres(source, model)


def write_model(path: Path, model: ChainModel) -> None:
    """Write a chain model as TOML or JSON, by file extension; the inverse of `read_model`."""
    data = as_data(model)
    if path.suffix.lower() == ".json":
        text = json.dumps(data, indent=1, ensure_ascii=False) + "\n"
    else:
        text = _toml(data)
    path.write_text(text, encoding="utf-8")


def as_data(model: ChainModel) -> dict[str, Any]:
    """Return a chain model as lists and dicts, without default values."""
    segments: list[dict[str, Any]] = []
    for s in model.segments:
        data: dict[str, Any] = {"name": s.name}
        if s.parent is not None:
            data["parent"] = s.parent
        data["joint"] = s.joint.kind
        for key in ("center_in_parent", "center", "axis", "rest", "limits"):
            value = getattr(s.joint, key)
            if value != getattr(Joint(), key):
                data[key] = list(value)
        if s.joint.path:
            data["path"] = [list(sample) for sample in s.joint.path]
        segments.append(data)

    markers: list[dict[str, Any]] = []
    for m in model.markers:
        markers.append({"name": m.name, "segment": m.segment, "position": list(m.position)})
        if m.weight != 1.0:
            markers[-1]["weight"] = m.weight
        if any(m.locked):
            markers[-1]["locked"] = "".join(compress(_AXES, m.locked))
    return {"name": model.name, "segment": segments, "marker": markers}


def _segment(data: dict[str, Any]) -> Segment:
    given: dict[str, Any] = {
        key: tuple(float(x) for x in data[key])
        for key in ("center_in_parent", "center", "axis", "rest", "limits")
        if key in data
    }
    given["path"] = tuple(tuple(float(x) for x in sample) for sample in data.get("path", ()))
    kind = data.get("joint", "ball" if "parent" in data else "free")
    return Segment(data["name"], data.get("parent"), Joint(kind, **given))


def _marker(data: dict[str, Any]) -> Marker:
    x, y, z = (float(value) for value in data["position"])
    locked = data.get("locked", "")
    return Marker(
        data["name"],
        data["segment"],
        (x, y, z),
        float(data.get("weight", 1.0)),
        ("x" in locked, "y" in locked, "z" in locked),
    )


def _wrong(data: Any) -> list[str]:
    """Return all errors in `data`."""
    if not isinstance(data, dict):
        return ["expected a table with name, segment and marker"]
    wrong = _unknown("model", "the model", data)
    if not isinstance(data.get("name", ""), str):
        wrong.append(f"the model: name must be text, is {data['name']!r}")

    for what in ("segment", "marker"):
        rows = data.get(what, [])
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            wrong.append(f"{what} must be a list of tables: [[{what}]]")
            continue
        for i, row in enumerate(rows, start=1):
            label = f"{what} {row.get('name', f'number {i}')!r}"
            wrong += _unknown(what, label, row)
            wrong += _wrong_values(what, label, row)
    return wrong


def _unknown(what: str, label: str, row: dict[str, Any]) -> list[str]:
    wrong = []
    for key in sorted(set(row) - _KEYS[what]):
        hint = did_you_mean(key, _KEYS[what]) or f"known: {', '.join(sorted(_KEYS[what]))}"
        wrong.append(f"{label}: no key {key!r}; {hint}")
    return wrong


def _wrong_values(what: str, label: str, row: dict[str, Any]) -> list[str]:
    wrong = [
        f"{label}: {key} must be {count} numbers, is {row[key]!r}"
        for key, count in _LENGTHS.items()
        if key in row and not _are_numbers(row[key], count)
    ]

    path = row.get("path", [])
    if not isinstance(path, list) or not all(_are_numbers(sample, _SAMPLE) for sample in path):
        wrong.append(f"{label}: path must be a list of samples, {_SAMPLE} numbers each")

    texts = {"name"} | ({"segment"} if what == "marker" else set())
    wrong += [f"{label}: needs a {key}" for key in sorted(texts) if key not in row]
    wrong += [
        f"{label}: {key} must be text, is {row[key]!r}"
        for key in ("name", "parent", "segment", "joint", "locked")
        if key in row and not isinstance(row[key], str)
    ]

    if what == "marker":
        wrong += [] if "position" in row else [f"{label}: needs a position"]
        locked = row.get("locked", "")
        if isinstance(locked, str) and not set(locked) <= set(_AXES):
            wrong.append(f'{label}: locked names axes such as "x" or "xyz", is {locked!r}')
        if not _are_numbers([row.get("weight", 1.0)], 1):
            wrong.append(f"{label}: weight must be a number, is {row['weight']!r}")
    elif isinstance(row.get("joint", "free"), str) and row.get("joint", "free") not in get_args(
        JointKind
    ):
        wrong.append(f"{label}: joint {row['joint']!r}, expected {', '.join(get_args(JointKind))}")
    return wrong


def _are_numbers(value: Any, count: int) -> bool:
    return (
        isinstance(value, list)
        and len(value) == count
        and all(isinstance(x, int | float) and not isinstance(x, bool) for x in value)
    )


def _toml(data: dict[str, Any]) -> str:
    lines = [f"name = {toml_value(data['name'])}"]

    for what in ("segment", "marker"):
        for row in data[what]:
            lines += ["", f"[[{what}]]", *(f"{key} = {_value(v)}" for key, v in row.items())]
    return "\n".join(lines) + "\n"


def _value(value: Any) -> str:
    if isinstance(value, str):
        return toml_value(value)
    if isinstance(value, list) and value and isinstance(value[0], list):
        return "[\n" + "".join(f"    {_value(row)},\n" for row in value) + "]"
    if isinstance(value, list):
        return f"[{', '.join(repr(float(x)) for x in value)}]"
    return repr(float(value))
