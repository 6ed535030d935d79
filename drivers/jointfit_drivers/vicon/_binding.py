"""Assignment of subjects, segments and markers to the names in rig.toml.

A subject with a single segment is a prop, whose body has the name of the subject. The segments of
other subjects are bodies with names such as ``Anna/LeftThigh``. Each subject has its own range of
ids.

Invariant: the module is pure. A name in rig.toml selects the same marker or segment even if the
server assigns other ids or lists its subjects in another order.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from jointfit_drivers.motion_capture import ColumnBinding, ModelEntry, bind_columns

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from jointfit_protocols.vicon import SubjectInfo

_MEMBER_BITS = 32


@dataclass(frozen=True, slots=True)
class ViconBinding:
    """Columns of the frames. They are valid until the subjects change."""

    columns: ColumnBinding
    subjects: tuple[SubjectInfo, ...]
    known_markers: frozenset[int]
    parents: dict[int, dict[int, int]]
    """Parent segment of each segment, by subject; 0 for a root."""


def bind_subjects(
    subjects: Sequence[SubjectInfo], markers: Mapping[str, str], bodies: Mapping[str, str]
) -> ViconBinding:
    """Return the columns for the subjects of a server.

    Parameters
    ----------
    subjects : sequence of SubjectInfo
        Most recent description of the subjects from the server.
    markers, bodies : mapping of str to str
        Names in rig.toml, each with the key that contains it, for messages.
    """
    of_markers = [
        ModelEntry(member_key(subject.subject, marker.id), subject.name, marker.name, number)
        for subject in subjects
        for number, marker in enumerate(subject.markers, 1)
    ]

    of_bodies = []
    for subject in subjects:
        keys = [member_key(subject.subject, segment.id) for segment in subject.segments]
        if len(keys) == 1:
            of_bodies.append(ModelEntry(keys[0], "", subject.name, 1))
            continue
        of_bodies += [
            ModelEntry(key, subject.name, segment.name, number)
            for number, (key, segment) in enumerate(zip(keys, subject.segments, strict=True), 1)
        ]

    parents = {
        subject.subject: {segment.id: segment.parent for segment in subject.segments}
        for subject in subjects
    }
    columns = bind_columns(of_markers, of_bodies, markers, bodies)
    known = frozenset(entry.key for entry in of_markers if isinstance(entry.key, int))
    return ViconBinding(columns, tuple(subjects), known, parents)


def member_key(subject: int, member: int) -> int:
    """Return the key of a segment or marker of a subject."""
    return subject << _MEMBER_BITS | member
