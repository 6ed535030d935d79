"""Assignment of the columns of frames to the names in rig.toml.

The plain marker name (``T1``) is sufficient if only one model has a marker with that name. The
names of model and marker together are always possible: ``Thigh/T1``, ``Thigh:T1``, ``Thigh_T1``, or
``Thigh_1`` with the number of the marker. The same applies to bones, and to bodies inside an asset
(an object of OptiTrack Motive that contains markers and rigid bodies).
A column gets the name that rig.toml uses for it. Other columns get the plain name if it is unique,
and ``Thigh/T1`` if it is not.

Invariant: the functions are pure. A plain name, or a name with its model, selects the same marker
whatever its id and the order of the models. ``Thigh_1`` depends on the order of the markers in the
model. The time is proportional to the size of the model. The number of columns is limited, because
the model in one datagram can contain 65 000 markers.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

from jointfit_daemon.model import DeviceEvent, MocapLayout
from jointfit_daemon.name_lists import list_names
from jointfit_daemon.nearest_name import nearest_name

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_daemon.driver import MocapSettings

ColumnKey = int | tuple[str, int]
"""Identity of a marker or body in the frames of a server: a number, or a name with a number."""

_MOST_COLUMNS = 2000
"""Largest number of columns in addition to those named in rig.toml. Further columns are dropped,
because each column takes time in every frame, and no camera system labels that many markers."""
MOST_NAMED = 50
"""Largest number of server names in a warning."""
_MOST_COMPARED = 500
"""Largest number of server names that are compared with a misspelled name."""
_MOST_SUGGESTED = 3
"""Largest number of misspelled names for which a similar name is suggested."""
_MOST_LISTED = 200
"""Largest number of names of markers or bodies in one event. The text of the event contains the
exact count."""


class ModelEntry(NamedTuple):
    """One marker or body of the server's model."""

    key: ColumnKey
    """Identity of the marker or body in the frames of the server."""
    owner: str
    """Name of the model or set that contains the entry; empty for a rigid body."""
    name: str
    member: int
    """Number of the entry in its owner, from 1."""

    @property
    def aliases(self) -> tuple[str, ...]:
        """Permitted spellings of the name in addition to the plain name."""
        if not self.owner:
            return ()
        joined = tuple(f"{self.owner}{mark}{self.name}" for mark in "/:_")
        return (*joined, f"{self.owner}_{self.member}")


@dataclass(frozen=True, slots=True)
class ColumnBinding:
    """Columns of the frames, valid until the server's model changes."""

    layout: MocapLayout
    markers: tuple[ColumnKey, ...]
    """Key of each marker column."""
    bodies: tuple[ColumnKey, ...]
    """Key of each body column."""
    warnings: tuple[str, ...]
    """Warnings about unknown and ambiguous names in rig.toml."""
    unknown: tuple[str, ...]
    """Names in rig.toml for which there is no column."""


def wanted_names(settings: MocapSettings) -> tuple[dict[str, str], dict[str, str]]:
    """Return the markers and bodies that rig.toml names, each with its key in rig.toml."""
    markers = {
        name: f"markers.{part}" for part, names in settings.markers.items() for name in names
    }
    bodies = {name: f"rigid_body.{part}" for part, name in settings.rigid_body.items()}
    return markers, bodies | ({settings.plate: "plate"} if settings.plate else {})


def bind_columns(
    markers: Sequence[ModelEntry],
    bodies: Sequence[ModelEntry],
    wanted_markers: Mapping[str, str],
    wanted_bodies: Mapping[str, str],
) -> ColumnBinding:
    """Return the columns for the markers and bodies of a server's model.

    Parameters
    ----------
    markers, bodies : sequence of ModelEntry
        Entries of the server's most recent description.
    wanted_markers, wanted_bodies : mapping of str to str
        Names in rig.toml, each with its key.
    """
    of_markers = _columns("marker", markers, wanted_markers)
    of_bodies = _columns("rigid body", bodies, wanted_bodies)
    return ColumnBinding(
        MocapLayout(tuple(of_markers.names), tuple(of_bodies.names)),
        tuple(of_markers.keys),
        tuple(of_bodies.keys),
        (*of_markers.warnings, *of_bodies.warnings),
        (*of_markers.unknown, *of_bodies.unknown),
    )


def renew_columns(
    before: ColumnBinding | None, binding: ColumnBinding, unpublished: int = 0
) -> tuple[ColumnBinding, list[DeviceEvent]]:
    """Return a new binding, with events for changed columns and new warnings.

    If the columns have not changed, the new binding uses the same layout object as `before`.

    Parameters
    ----------
    before : ColumnBinding, optional
        Binding that was used so far; None for the first binding.
    binding : ColumnBinding
        Binding that is used from now on.
    unpublished : int
        Number of frames that arrived before the first model.
    """
    layout = binding.layout
    listed = list(layout.markers[:_MOST_LISTED])
    events = []
    if before is not None and before.layout == layout:
        binding = replace(binding, layout=before.layout)
    else:
        text = f"{len(layout.markers)} markers, {len(layout.bodies)} bodies"
        bodies = list(layout.bodies[:_MOST_LISTED])
        data = {"markers": listed, "bodies": bodies, "unpublished": unpublished}
        events.append(DeviceEvent("info", text, data))

    if before is None or before.warnings != binding.warnings:
        unknown = {"unknown": list(binding.unknown), "known": listed}
        events += [DeviceEvent("warning", text, unknown) for text in binding.warnings]
    return binding, events


# --- names of the columns ---------------------------------------------------------------------


class _Columns(NamedTuple):
    names: list[str]
    keys: list[ColumnKey]
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

    # Entries that rig.toml already uses are not suggested for another name.
    used_by_rig = {
        entry.name for name in wanted for entry in plain.get(name) or alias.get(name) or []
    }
    free_entries = {name: found for name, found in plain.items() if name not in used_by_rig}
    taken: set[ColumnKey] = set()
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
            free_entries.pop(near or "", None)  # a marker is suggested only once
            problem = "is not in the stream" + (f"; did you mean {near!r}?" if near else ".")
            if fitting:
                choices = [repr(next(iter(e.aliases), e.name)) for e in fitting[:MOST_NAMED]]
                problem = f"is ambiguous: write {' or '.join(choices)}."
            problems.append(f"{what} {name!r} (mocap.{key}) {problem}")

    used = set(found.names)
    most = _MOST_COLUMNS + len(used)
    for entry in entries:
        if len(used) >= most:
            text = f"the server has {len(entries)} columns ({what}); {len(used)} are used"
            found.warnings.append(text)
            break
        free = None if entry.key in taken else _unused_name(entry, plain, used)
        if free is not None:  # None: the column exists, or all names are used
            found.names.append(free)
            found.keys.append(entry.key)
            used.add(free)
            taken.add(entry.key)

    if problems:
        server = list_names(sorted(plain), MOST_NAMED) or "none"
        found.warnings.append(f"{' '.join(problems)} The server has: {server}")
    return found


def _unused_name(
    entry: ModelEntry, plain: Mapping[str, list[ModelEntry]], used: set[str]
) -> str | None:
    """Return the first unused name: plain if unique, or with its owner; None if there is none."""
    full = f"{entry.owner}/{entry.name}" if entry.owner else entry.name
    choices = [entry.name] if len(plain[entry.name]) == 1 else []
    choices += [full, f"{full}#{entry.member}", f"{full}#{entry.key}"]
    return next((name for name in choices if name not in used), None)
