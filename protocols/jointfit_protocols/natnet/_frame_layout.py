"""Fast decoding of frames with the same bodies, markers and marker sets as an earlier frame.

A server repeats its model in every frame. The counts and names in one frame therefore determine the
position of every number in the next frame. A frame with a different count or name has a different
layout.

Invariant: the result equals the result of `decode_frame`, or is None. If marker sets are selected,
the result contains neither the other sets nor the unlabeled markers.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.natnet._cursor import I32, XYZ
from jointfit_protocols.natnet._frame import (
    BODY_LAYOUT,
    END_LAYOUT,
    MARKER_LAYOUT,
    PRECISION_LAYOUT,
    SIZED,
    STAMPS_LAYOUT,
    TICKED,
    Body,
    FrameOfData,
    LabeledMarker,
    MarkerSet,
    Position,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from jointfit_protocols.natnet._frame import Version

_HEADER_BYTES = 4
_body: Callable[[Iterable[object]], Body] = partial(tuple.__new__, Body)
_marker: Callable[[Iterable[object]], LabeledMarker] = partial(tuple.__new__, LabeledMarker)
"""Constructor of a named tuple from an unpacked record. It takes a third of the time of ``_make``,
which checks the length."""


_Span = tuple[int, int]
"""First byte of a section, and first byte after it."""


class _FramePlaces(NamedTuple):
    """Positions of the numbers in a frame."""

    sets: tuple[tuple[str, _Span], ...]
    """Marker sets that are read, each with its position."""
    unread: tuple[_Span, ...]
    """Positions of the marker sets that are not read."""
    others: _Span
    all_read: bool
    """Whether all marker sets and the unlabeled markers are read."""
    bodies: _Span
    markers: _Span
    stamps: int
    precision: bool
    end: int


class FrameLayout:
    """Positions of the numbers in a frame, and all other bytes of the frame.

    Parameters
    ----------
    places : _FramePlaces
        Positions of the numbers that change from frame to frame.
    example : bytes
        Datagram of the first frame.
    """

    __slots__ = ("_fixed", "_mask", "_places", "_size")

    def __init__(self, places: _FramePlaces, example: bytes) -> None:
        self._places, self._size = places, len(example)
        fixed = bytearray(b"\xff" * len(example))
        number = (_HEADER_BYTES, _HEADER_BYTES + I32.size)
        tail = (places.stamps, places.end + 2)  # the flags of the frame, not its end tag
        sets = (*(one for _, one in places.sets), *places.unread)
        changing = (number, *sets, places.others, places.bodies)
        for start, stop in (*changing, places.markers, tail):
            fixed[start:stop] = bytes(stop - start)

        # A single comparison of long integers checks all counts and names.
        self._mask = int.from_bytes(fixed, "little")
        self._fixed = int.from_bytes(example, "little") & self._mask

    @staticmethod
    def of(
        datagram: bytes,
        frame: FrameOfData,
        version: Version,
        selected: frozenset[str] | None = None,
    ) -> FrameLayout | None:
        """Return the layout of a decoded frame; None if it contains items without fixed positions.

        Parameters
        ----------
        datagram, frame, version
            The frame as received, the decoded frame, and its bitstream version.
        selected : frozenset of str, optional
            Names of the marker sets to read. By default everything is read. A server repeats each
            marker in two sets. To read both sets takes as long as to read the rest of a frame.
        """
        if frame.skeletons or frame.assets or frame.force_plates or frame.devices or frame.skipped:
            return None
        if version < TICKED:
            return None
        head = 2 * I32.size if version >= SIZED else I32.size
        at = _HEADER_BYTES + I32.size + head

        sets, unread = [], []
        for marker_set in frame.marker_sets:
            at = datagram.index(0, at) + 1 + I32.size
            span = _span(at, XYZ.size * len(marker_set.positions))
            at = span[1]
            if selected is None or marker_set.name in selected:
                sets.append((marker_set.name, span))
            else:
                unread.append(span)
        others = _span(at + head, XYZ.size * len(frame.other_markers))
        bodies = _span(others[1] + head, BODY_LAYOUT.size * len(frame.bodies))
        absent = 2 if version >= SIZED else 1  # skeletons, and assets if the bitstream has them
        labeled = bodies[1] + absent * head + head
        markers = _span(labeled, MARKER_LAYOUT.size * len(frame.markers))
        stamps = markers[1] + 2 * head  # no force plates and no devices

        precision = frame.precision is not None
        end = stamps + STAMPS_LAYOUT.size + (PRECISION_LAYOUT.size if precision else 0)
        places = _FramePlaces(
            tuple(sets), tuple(unread), others, selected is None, bodies, markers, stamps,
            precision, end,
        )  # fmt: skip
        return FrameLayout(places, datagram) if end + END_LAYOUT.size == len(datagram) else None

    def read(self, datagram: bytes) -> FrameOfData | None:
        """Return the frame in `datagram`; None if the frame has a different layout."""
        if len(datagram) != self._size:
            return None
        if int.from_bytes(datagram, "little") & self._mask != self._fixed:
            return None

        sets, _, others, all_read, bodies, markers, at, precise, end = self._places
        number: int = I32.unpack_from(datagram, _HEADER_BYTES)[0]
        stamps = STAMPS_LAYOUT.unpack_from(datagram, at)
        timecode, subframe, timestamp, exposure, received, transmit = stamps
        return FrameOfData(
            number, timestamp, exposure, received, transmit,
            END_LAYOUT.unpack_from(datagram, end)[0],
            tuple(map(_body, BODY_LAYOUT.iter_unpack(datagram[bodies[0] : bodies[1]]))),
            tuple(map(_marker, MARKER_LAYOUT.iter_unpack(datagram[markers[0] : markers[1]]))),
            tuple([MarkerSet(name, _positions(datagram, span)) for name, span in sets]),
            _positions(datagram, others) if all_read else (),
            timecode=timecode, subframe=subframe,
            precision=_precision(datagram, end) if precise else None,
        )  # fmt: skip


def _precision(datagram: bytes, end: int) -> tuple[int, int]:
    seconds, fraction = PRECISION_LAYOUT.unpack_from(datagram, end - PRECISION_LAYOUT.size)
    return seconds, fraction


def _positions(datagram: bytes, span: _Span) -> tuple[Position, ...]:
    return tuple(XYZ.iter_unpack(datagram[span[0] : span[1]]))


def _span(start: int, size: int) -> _Span:
    return start, start + size
