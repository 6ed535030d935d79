"""Current objects of a Vicon DataStream after each packet.

A packet consists of objects. Static objects describe the scene, such as its subjects. Dynamic
objects contain the data of one frame. Static and dynamic objects form two separate sets. A packet
without static objects does not change the static set. Otherwise the new static set consists of the
objects in the packet, and of the types that the object ``Contents`` lists as unchanged. The dynamic
set is updated in the same way. A type that is neither present nor unchanged is not visible.

Invariant: the module is pure.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_protocols import vicon

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_protocols.vicon import Object


class SceneState:
    """The current static and dynamic objects."""

    def __init__(self) -> None:
        self._static: dict[int, list[Object]] = {}
        self._dynamic: dict[int, list[Object]] = {}

    def add(self, objects: Sequence[Object]) -> None:
        """Update both sets with the objects of a packet."""
        unchanged = frozenset[int]()
        found: dict[int, list[Object]] = {}
        for item in objects:
            if isinstance(item, vicon.Contents):
                unchanged |= item.unchanged
            elif isinstance(item, vicon.Segments | vicon.OpaqueObject):
                found.setdefault(item.id, []).append(item)
            else:
                found.setdefault(_IDS.get(type(item), -1), []).append(item)

        for kinds, current in ((vicon.STATIC, self._static), (vicon.DYNAMIC, self._dynamic)):
            present = {kind: items for kind, items in found.items() if kind in kinds}
            if present:
                for kind in current.keys() - unchanged:
                    del current[kind]
                current.update(present)

    @property
    def subjects(self) -> tuple[vicon.SubjectInfo, ...]:
        """Subjects in the order of the server."""
        items = self._static.get(vicon.ObjectId.SUBJECT_INFO, [])
        return tuple(item for item in items if isinstance(item, vicon.SubjectInfo))

    def static(self, kind: int) -> list[Object]:
        """Return the static objects of a type."""
        return self._static.get(kind, [])

    def dynamic(self, kind: int) -> list[Object]:
        """Return the dynamic objects of a type."""
        return self._dynamic.get(kind, [])


_IDS: dict[type, int] = {
    vicon.StreamInfo: vicon.ObjectId.STREAM_INFO,
    vicon.SubjectInfo: vicon.ObjectId.SUBJECT_INFO,
    vicon.FrameInfo: vicon.ObjectId.FRAME_INFO,
    vicon.LabeledRecons: vicon.ObjectId.LABELED_RECONS,
    vicon.LightSegments: vicon.ObjectId.LIGHT_SEGMENTS,
    vicon.StreamTimecode: vicon.ObjectId.TIMECODE,
    vicon.LatencyInfo: vicon.ObjectId.LATENCY_INFO,
    vicon.HardwareFrame: vicon.ObjectId.HARDWARE_FRAME,
    vicon.ApplicationInfo: vicon.ObjectId.APPLICATION_INFO,
    vicon.FrameRates: vicon.ObjectId.FRAME_RATES,
    vicon.ObjectQuality: vicon.ObjectId.OBJECT_QUALITY,
}
