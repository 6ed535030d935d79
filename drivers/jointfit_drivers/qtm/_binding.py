"""Binding of places in the components of frames to the names in rig.toml.

Markers and bodies have no ids: their order is the order in the settings XML. A body whose pose QTM
gives relative to another body, or to a fixed pose, is refused.

Invariant: pure; a binding applies only to frames with the numbers of markers and bodies of its XML.
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
    """Columns of the frames, until the settings change."""

    columns: ColumnBinding
    marker_places: list[int]
    """Place of each marker column in the 3D component."""
    body_keys: tuple[int, ...]
    """Place of each body column in the 6D component, or its `segment_key`."""
    labels: int
    """Number of labeled markers."""
    bodies: int
    """Number of 6DOF bodies."""
    enabled: tuple[int, ...]
    """Places of the enabled bodies."""
    skeletons: int

    def body_places(self, count: int) -> tuple[int, ...] | None:
        """Return the number of the body at each place of a component of `count` bodies.

        None if the component does not fit the settings.
        """
        if count == self.bodies:
            return tuple(range(count))
        return self.enabled if count == len(self.enabled) else None


def bind_settings(
    settings: QtmSettingsXml, markers: Mapping[str, str], bodies: Mapping[str, str]
) -> QtmBinding:
    """Return the columns for the settings of a server.

    Parameters
    ----------
    settings : QtmSettingsXml
        The server's latest settings.
    markers, bodies : mapping of str to str
        Names in rig.toml, and the key of each.
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
    """Return the key of a segment: negative, so that it is no place of a body."""
    return -1 - (skeleton << _MEMBER_BITS | segment)
