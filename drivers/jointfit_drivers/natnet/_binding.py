"""Assignment of the ids in frames to the names in rig.toml.

A labeled marker has the id ``model << 16 | member``. The model is a rigid body, a skeleton or an
asset. The name of a member is the marker name in the description (bitstream 4.0 and later). Without
such a name, the member has the name of the marker at the same position in the marker set with the
model's name. Without such a set, the markers of a rigid body are named ``Marker1``, ``Marker2`` and
so on; the markers of a skeleton have no names and are not used. Markers of a set without a model
are identified by set and position. The set ``all`` is ignored, because it repeats the other sets.

`jointfit_drivers.motion_capture.bind_columns` defines the names of the columns.

Invariant: the module is pure. The name of a rigid body selects the same column when the server
assigns other ids or lists its models in another order. The same applies to a marker whose name is
in the description.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from jointfit_drivers.motion_capture import (
    MOST_NAMED,
    ColumnBinding,
    ColumnKey,
    ModelEntry,
    bind_columns,
)
from jointfit_protocols import natnet

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from types import UnionType


_MODELS = natnet.BodyDescription | natnet.SkeletonDescription | natnet.AssetDescription
_EVERY = "all"
_MEMBER_BITS = 16
_MEMBER = (1 << _MEMBER_BITS) - 1


@dataclass(frozen=True, slots=True)
class Binding:
    """Columns of the frames, valid until the server's model changes."""

    columns: ColumnBinding
    known: frozenset[ColumnKey]
    """All ids in the model, including ids that are not used because several models share them."""
    loose_sets: frozenset[str]
    """Names of marker sets whose positions are read directly from the sets."""


def bind_model(
    model: natnet.ModelDefinition, markers: Mapping[str, str], bodies: Mapping[str, str]
) -> Binding:
    """Return the columns for a model of the server.

    Parameters
    ----------
    model : ModelDefinition
        Most recent description from the server.
    markers, bodies : mapping of str to str
        Names in rig.toml, each with its key.
    """
    shared, shared_bodies = _shared_ids(model, _MODELS), _shared_ids(model, natnet.BodyDescription)

    # All rigid bodies, including those inside skeletons and assets.
    all_bodies: list[ModelEntry] = []
    for item in model.descriptions:
        if isinstance(item, natnet.BodyDescription):
            all_bodies.append(ModelEntry(item.id, "", item.name, 1))
        elif isinstance(item, natnet.SkeletonDescription | natnet.AssetDescription):
            inner = item.bones if isinstance(item, natnet.SkeletonDescription) else item.bodies
            all_bodies += [
                ModelEntry(body_key(item.id, body.id), item.name, body.name, number)
                for number, body in enumerate(inner, 1)
            ]

    all_markers = _marker_entries(model)
    bodies_found = [e for e in all_bodies if e.owner or e.key not in shared_bodies]
    markers_found = [
        e for e in all_markers if not isinstance(e.key, int) or e.key >> _MEMBER_BITS not in shared
    ]

    columns = bind_columns(markers_found, bodies_found, markers, bodies)
    refused = tuple(
        f"{' and '.join(names[:MOST_NAMED])} have the same streaming id and are not used: give "
        "each its own id"
        for names in list(shared.values())[:MOST_NAMED]
    )

    loose = frozenset(entry.key[0] for entry in markers_found if isinstance(entry.key, tuple))
    known = frozenset(entry.key for entry in (*all_bodies, *all_markers))
    return Binding(replace(columns, warnings=(*columns.warnings, *refused)), known, loose)


def body_key(owner: int, member: int) -> int:
    """Return the id that a bone, or a body or marker of an asset, has in frames."""
    return owner << _MEMBER_BITS | (member & _MEMBER)


# --- entries of the model ---------------------------------------------------------------------


def _marker_entries(model: natnet.ModelDefinition) -> list[ModelEntry]:
    sets = {
        m.name: m.markers for m in model.descriptions if isinstance(m, natnet.MarkerSetDescription)
    }
    found: list[ModelEntry] = []

    for item in model.descriptions:
        if isinstance(item, natnet.BodyDescription):
            named = (item.markers, sets.get(item.name, ()))
            names = [
                next((n[i] for n in named if i < len(n) and n[i]), f"Marker{i + 1}")
                for i in range(max(len(item.positions), len(named[1])))
            ]
            found += _members(item.id, item.name, names)
        elif isinstance(item, natnet.SkeletonDescription):
            found += _members(item.id, item.name, sets.get(item.name, ()))
        elif isinstance(item, natnet.AssetDescription):
            found += [
                ModelEntry(body_key(item.id, m.id), item.name, m.name, number)
                for number, m in enumerate(item.markers, 1)
            ]

    owners = {_EVERY, *(item.name for item in model.descriptions if isinstance(item, _MODELS))}
    for name, texts in sets.items():
        if name not in owners:
            found += [ModelEntry((name, i), name, text, i + 1) for i, text in enumerate(texts)]
    return found


def _members(model: int, owner: str, names: Iterable[str]) -> list[ModelEntry]:
    return [ModelEntry(body_key(model, i), owner, name, i) for i, name in enumerate(names, 1)]


def _shared_ids(
    model: natnet.ModelDefinition, kinds: type | UnionType
) -> dict[ColumnKey, list[str]]:
    """Return the ids that several models of these kinds use, with the names of the models."""
    names: defaultdict[ColumnKey, list[str]] = defaultdict(list)
    for item in model.descriptions:
        if isinstance(item, kinds) and isinstance(item, _MODELS):
            names[item.id].append(item.name)
    return {number: found for number, found in names.items() if len(found) > 1}
