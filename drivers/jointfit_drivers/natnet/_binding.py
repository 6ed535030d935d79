"""Binding of the ids in frames to the names in rig.toml.

A labeled marker has id ``model << 16 | member``. The model is a rigid body, a skeleton or an asset.
The name of its member is, in this order: the marker name in the description (bitstream 4.0 on), the
name at that place in the marker set of the model's name, or ``Marker1``, ``Marker2`` and so on.
Markers of a set without a model are identified by set and place; the set ``all`` repeats others.

The plain marker name (``T1``) is sufficient where only one model has that name. A name with its
model is always possible: ``Thigh/T1``, ``Thigh:T1``, ``Thigh_T1``, or, as in the server's list
of all markers, ``Thigh_1``. The same holds for bones and for bodies of assets. A column has the
name in rig.toml, otherwise the plain name if it is unique, otherwise ``Thigh/T1``.

Invariant: pure; only names matter, not ids and orders. The time grows linearly with the model, and
the number of columns is bounded, because a model of one datagram can contain 65 000 markers.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.model import MocapLayout
from jointfit_daemon.nearest_name import nearest_name
from jointfit_protocols import natnet

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from types import UnionType


Key = int | tuple[str, int]
"""Id of a labeled marker or body, or set name and place in the set."""

_MODELS = natnet.BodyDescription | natnet.SkeletonDescription | natnet.AssetDescription
_EVERY = "all"
_MOST_COLUMNS = 2000
"""Columns besides those named in rig.toml. Further ones are dropped, because each costs time in
every frame, and no camera system labels as many.
"""
_MOST_NAMED = 50
"""Names of the server that a warning lists."""
_MOST_COMPARED = 500
"""Names of the server that are compared with a misspelt one."""
_MOST_SUGGESTED = 3
"""Misspelt names for which a similar one is suggested."""
_MEMBER_BITS = 16
_MEMBER = (1 << _MEMBER_BITS) - 1


class ModelEntry(NamedTuple):
    """One marker or body of the server's model."""

    key: Key
    owner: str
    """Its model or set; empty for a rigid body."""
    name: str
    member: int
    """Number in its owner, from 1."""

    @property
    def aliases(self) -> tuple[str, ...]:
        """Spellings besides the plain name."""
        if not self.owner:
            return ()
        joined = tuple(f"{self.owner}{mark}{self.name}" for mark in "/:_")
        return (*joined, f"{self.owner}_{self.member}")


@dataclass(frozen=True, slots=True)
class Binding:
    """Columns of the frames, until the model changes."""

    layout: MocapLayout
    markers: tuple[Key, ...]
    """Key of each marker column."""
    bodies: tuple[Key, ...]
    """Key of each body column."""
    known: frozenset[Key]
    """Every id in the model, refused ones included."""
    loose_sets: frozenset[str]
    """Marker sets whose positions are read from the sets themselves."""
    warnings: tuple[str, ...]
    """Warnings: unknown names of rig.toml, and ids that occur twice."""
    unknown: tuple[str, ...]
    """Names of rig.toml without a column."""


def bind_model(
    model: natnet.ModelDefinition, markers: Mapping[str, str], bodies: Mapping[str, str]
) -> Binding:
    """Return the columns for a model.

    Parameters
    ----------
    model : ModelDefinition
        The server's latest description.
    markers, bodies : mapping of str to str
        Names in rig.toml, and the key of each.
    """
    shared, shared_bodies = _shared_ids(model, _MODELS), _shared_ids(model, natnet.BodyDescription)

    # All bodies, with those inside skeletons and assets.
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

    marker_columns = _columns("marker", markers_found, markers)
    body_columns = _columns("rigid body", bodies_found, bodies)

    loose = frozenset(entry.key[0] for entry in markers_found if isinstance(entry.key, tuple))
    known = frozenset(entry.key for entry in (*all_bodies, *all_markers))
    for names in list(shared.values())[:_MOST_NAMED]:
        text = f"streaming id shared by {' and '.join(names[:_MOST_NAMED])}: refused"
        marker_columns.warnings.append(f"{text}; give each its own")

    return Binding(
        MocapLayout(tuple(marker_columns.names), tuple(body_columns.names)),
        tuple(marker_columns.keys),
        tuple(body_columns.keys),
        known,
        loose,
        (*marker_columns.warnings, *body_columns.warnings),
        (*marker_columns.unknown, *body_columns.unknown),
    )


def body_key(owner: int, member: int) -> int:
    """Return the id in frames of a bone, or of a body or marker of an asset."""
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


def _shared_ids(model: natnet.ModelDefinition, kinds: type | UnionType) -> dict[Key, list[str]]:
    """Return the ids that several models of these kinds have, and the names of the models."""
    names: defaultdict[Key, list[str]] = defaultdict(list)
    for item in model.descriptions:
        if isinstance(item, kinds) and isinstance(item, _MODELS):
            names[item.id].append(item.name)
    return {number: found for number, found in names.items() if len(found) > 1}


# --- names of the columns ---------------------------------------------------------------------


class _Columns(NamedTuple):
    names: list[str]
    keys: list[Key]
    warnings: list[str]
    unknown: list[str]


def _columns(what: str, entries: Sequence[ModelEntry], wanted: Mapping[str, str]) -> _Columns:
    found = _Columns([], [], [], [])
    plain: defaultdict[str, list[ModelEntry]] = defaultdict(list)
    alias: defaultdict[str, list[ModelEntry]] = defaultdict(list)
    for entry in entries:
        plain[entry.name].append(entry)
        for spelling in entry.aliases:
            alias[spelling].append(entry)

    # Entries that rig.toml uses already are no suggestion for another name.
    used_by_rig = {
        entry.name for name in wanted for entry in plain.get(name) or alias.get(name) or []
    }
    free_entries = {name: found for name, found in plain.items() if name not in used_by_rig}
    taken: set[Key] = set()
    problems: list[str] = []
    for name, key in wanted.items():
        fitting = plain.get(name) or alias.get(name) or []
        if len(fitting) == 1:
            found.names.append(name)
            found.keys.append(fitting[0].key)
            taken.add(fitting[0].key)
        else:
            found.unknown.append(name)
            known = free_entries if len(problems) < _MOST_SUGGESTED else {}
            near = None if fitting else nearest_name(name, islice(known, _MOST_COMPARED))
            free_entries.pop(near or "", None)  # two names in rig.toml are not one marker
            problems.append(f"{what} {name!r} (mocap.{key}) {_problem(fitting, near)}")

    used = set(found.names)
    most = _MOST_COLUMNS + len(used)
    for entry in entries:
        if len(used) >= most:
            text = f"the server has {len(entries)} columns ({what}); {len(used)} are used"
            found.warnings.append(text)
            break
        free = None if entry.key in taken else _unused_name(entry, plain, used)
        if free is not None:  # otherwise its id occurs twice, and frames with it are refused
            found.names.append(free)
            found.keys.append(entry.key)
            used.add(free)
            taken.add(entry.key)

    if problems:
        server = ", ".join(sorted(plain)[:_MOST_NAMED]) or "none"
        more = f" and {len(plain) - _MOST_NAMED} more" if len(plain) > _MOST_NAMED else ""
        found.warnings.append(f"{' '.join(problems)} The server has: {server}{more}")
    return found


def _problem(fitting: list[ModelEntry], near: str | None) -> str:
    if fitting:
        choices = [repr(next(iter(e.aliases), e.name)) for e in fitting[:_MOST_NAMED]]
        return f"is ambiguous: write {' or '.join(choices)}."
    return "is not in the stream" + (f"; did you mean {near!r}?" if near else ".")


def _unused_name(
    entry: ModelEntry, plain: Mapping[str, list[ModelEntry]], used: set[str]
) -> str | None:
    """Return the plain name if it is unique, otherwise one with its owner; None if all are used."""
    full = f"{entry.owner}/{entry.name}" if entry.owner else entry.name
    choices = [entry.name] if len(plain[entry.name]) == 1 else []
    choices += [full, f"{full}#{entry.member}", f"{full}#{entry.key}"]
    return next((name for name in choices if name not in used), None)
