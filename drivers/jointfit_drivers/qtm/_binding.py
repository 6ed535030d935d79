"""Assignment of the markers and bodies in QTM's frames to the names in rig.toml.

Markers and bodies have no ids: a frame contains them in the order of QTM's settings, which are an
XML document. QTM can send the pose of a body relative to another body or to a fixed pose. Such a
body is rejected.

Invariant: the module is pure. A binding applies only to frames with the same numbers of markers and
bodies as the settings from which the binding was made.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from jointfit_drivers.motion_capture import (
    MOST_NAMED,
    ColumnBinding,
    ModelEntry,
    bind_columns,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_protocols.qtm import QtmSettingsXml

_MEMBER_BITS = 32


@dataclass(frozen=True, slots=True)
class QtmBinding:
    """Columns of the frames. They are valid until the settings change."""

    columns: ColumnBinding
    marker_places: list[int]
    """For each marker column, the index of the marker in the 3D component (the part of a frame with
    the markers)."""
    body_keys: tuple[int, ...]
    """For each body column, the index of the body in QTM's settings, or the `segment_key` of a
    skeleton segment."""
    labels: int
    """Number of labeled markers in QTM's settings."""
    bodies: int
    """Number of 6DOF bodies in QTM's settings, whether enabled or not."""
    enabled: tuple[int, ...]
    """Indices of the enabled bodies in QTM's settings."""
    skeletons: int

    def body_places(self, count: int) -> tuple[int, ...] | None:
        """Return the index in QTM's settings of each body of a 6D component with `count` bodies.

        The 6D component is the part of a frame with the bodies. It contains all bodies of the
        settings or only the enabled ones. Return None if `count` is neither of these numbers.
        """
        if count == self.bodies:
            return tuple(range(count))
        return self.enabled if count == len(self.enabled) else None


def bind_settings(
    settings: QtmSettingsXml, markers: Mapping[str, str], bodies: Mapping[str, str]
) -> QtmBinding:
    """Return the columns that correspond to the settings of a server.

    Parameters
    ----------
    settings : QtmSettingsXml
        Most recent settings of the server.
    markers, bodies : mapping of str to str
        Names in rig.toml, each with the key that contains it, for messages.
    """
    of_markers = [
        ModelEntry(place, "", name, place + 1)
        for place, name in enumerate(settings.labels or ())
        if name
    ]

    described = settings.bodies or ()
    skeletons = settings.skeletons or ()
    moved = [body.name for body in described if body.relative or body.fixed]
    of_bodies = [
        ModelEntry(place, "", body.name, place + 1)
        for place, body in enumerate(described)
        if body.name and not (body.relative or body.fixed)
    ]
    of_bodies += [
        ModelEntry(segment_key(number, id_), skeleton.name, name, member)
        for number, skeleton in enumerate(skeletons)
        for member, (id_, name) in enumerate(skeleton.segments, 1)
    ]

    columns = bind_columns(of_markers, of_bodies, markers, bodies)
    refused = tuple(
        f"the pose of rigid body {name!r} is relative to another body or to a fixed pose, and not "
        "to the world: refused; in QTM set its data origin and orientation to global"
        for name in moved[:MOST_NAMED]
    )
    return QtmBinding(
        replace(columns, warnings=(*columns.warnings, *refused)),
        [key for key in columns.markers if isinstance(key, int)],
        tuple(key for key in columns.bodies if isinstance(key, int)),
        len(settings.labels or ()),
        len(described),
        tuple(place for place, body in enumerate(described) if body.enabled),
        len(skeletons),
    )


def segment_key(skeleton: int, segment: int) -> int:
    """Return the key of a skeleton segment.

    The key is negative, so that it differs from body indices.
    """
    return -1 - (skeleton << _MEMBER_BITS | segment)
