"""LPMS sensors on CAN: channels in up to four frames per period, and heartbeats.

    16 bit   | channel 4 k + 1 | 4 k + 2 | 4 k + 3 | 4 k + 4 |    4 x int16, k = 0 to 3
    32 bit   | channel 2 k + 1 | 2 k + 2 |                        2 x float32, k = 0 to 3

Numbers are little-endian. The user selects the quantity of each channel over the sensor's UART, so
the channels of w, x, y and z are settings. The sensor cannot send a time or a sequence number.

A quaternion in two frames is complete only if the frames follow each other in order and within half
a period. Halves from different instants would yield a wrong orientation.

A sensor has two modes, which differ only in the identifiers. CANopen style uses 0x180, 0x280, 0x380
and 0x480 plus the node number, and a heartbeat at 0x700 plus the node number. In sequential mode,
the identifiers follow a start identifier by one of two rules (`sequential_ids`).

Source: the vendor's page on CAN parsing for LPMS3; firmware source of 2013.

Invariant: the codec converts frames to quaternions. It uses no bus and no clock.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Literal, NamedTuple

from jointfit_protocols.can import CanFrame
from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

Precision = Literal["int16", "float32"]

FRAMES = 4
"""Number of frames that a sensor sends in each period."""
FRAME_BYTES = 8
HEARTBEAT = 0x700
"""Identifier of the heartbeat of the node 0."""
TPDO = (0x180, 0x280, 0x380, 0x480)
"""Identifiers of the frames of the node 0 in CANopen style. TPDO means transmit process data
object."""
OPERATIONAL = 5
"""State in the heartbeat of a sensor that sends data."""
BOOTED = 0
"""State in the first heartbeat after a start, as defined by CANopen."""
START_ID = 0x514
"""Default start identifier of sequential mode."""
_STRUCTS = {"int16": struct.Struct("<4h"), "float32": struct.Struct("<2f")}
PER_FRAME: dict[Precision, int] = {"int16": 4, "float32": 2}
"""Number of channels in each frame."""


def tpdo_ids(node: int) -> tuple[int, int, int, int]:
    """Return the identifiers of a node in CANopen style."""
    first, second, third, fourth = (base + node for base in TPDO)
    return first, second, third, fourth


def sequential_ids(
    node: int, start_id: int = START_ID, *, spaced: bool
) -> tuple[int, int, int, int]:
    """Return the identifiers of a node in sequential mode.

    The vendor's sources disagree. According to the page on LPMS3, the identifiers are ``start_id +
    node + k``, so the identifiers of adjacent nodes overlap. According to the firmware of 2013 and
    another page, they are ``start_id + 8 (node - 1) + k`` (`spaced`).
    """
    base = start_id + (8 * (node - 1) if spaced else node)
    return base, base + 1, base + 2, base + 3


class ChannelIds(NamedTuple):
    """Identifiers of one sensor, each with 11 bits."""

    frames: tuple[int, int, int, int]
    heartbeat: int | None = None


class ChannelQuaternion(NamedTuple):
    """One quaternion with its values as sent."""

    t_ns: int
    """Stamp of the quaternion's first frame, ns."""
    values: tuple[float, float, float, float]
    """Components w, x, y and z. With 16 bits they are integers."""


class Heartbeat(NamedTuple):
    """State that a sensor reports about itself."""

    t_ns: int
    state: int


def decode_frame(data: bytes, precision: Precision) -> tuple[float, ...] | None:
    """Return the channels in the data of a frame; None if the data do not have 8 bytes."""
    return _STRUCTS[precision].unpack(data) if len(data) == FRAME_BYTES else None


def encode_frames(
    ids: Sequence[int], channels: Sequence[float], precision: Precision, t_ns: int = 0
) -> list[CanFrame]:
    """Return the frames of one period. Integers are rounded and limited to 16 bits.

    Parameters
    ----------
    ids
        Identifiers of the four frames.
    channels
        Values of all channels: 16 channels with 16 bits, or 8 channels with 32 bits.
    precision
        Format of the channels.
    t_ns
        Stamp of the frames, ns.
    """
    count = PER_FRAME[precision]
    values = [
        value if precision == "float32" else max(-0x8000, min(0x7FFF, round(value)))
        for value in channels
    ]
    return [
        CanFrame(t_ns, number, _STRUCTS[precision].pack(*values[k * count : (k + 1) * count]))
        for k, number in enumerate(ids)
    ]


def encode_heartbeat(number: int, state: int = OPERATIONAL, t_ns: int = 0) -> CanFrame:
    """Return a heartbeat with identifier `number`."""
    return CanFrame(t_ns, number, bytes((state,)).ljust(FRAME_BYTES, b"\0"))


def frames_of(channels: Iterable[int], precision: Precision) -> tuple[int, ...]:
    """Return the indices of the frames that contain `channels` (counted from 1), ascending."""
    return tuple(sorted({(channel - 1) // PER_FRAME[precision] for channel in channels}))


class LpmsCanCodec:
    """Codec that converts one sensor's frames to quaternions; it never raises.

    Frames with other identifiers are counted and ignored.

    Parameters
    ----------
    ids : ChannelIds
        Identifiers of the sensor.
    precision : Precision
        Format of the channels.
    mapping : tuple of int
        Channels of w, x, y and z, counted from 1.
    longest_ns : int
        Longest time between the frames of one quaternion, ns, equal to half a period.
    """

    def __init__(
        self,
        ids: ChannelIds,
        precision: Precision,
        mapping: tuple[int, int, int, int],
        longest_ns: int,
    ) -> None:
        used = frames_of(mapping, precision)
        self._order = {ids.frames[index]: place for place, index in enumerate(used)}
        self._idle = {*ids.frames} - self._order.keys()
        self._heartbeat = ids.heartbeat
        self._parts = len(used)
        self._unpack = _STRUCTS[precision].unpack
        count = PER_FRAME[precision]
        places = [used.index((c - 1) // count) * count + (c - 1) % count for c in mapping]
        self._places = (places[0], places[1], places[2], places[3])
        self._longest_ns = longest_ns
        self._values: tuple[float, ...] = ()
        self._received = 0  # frames of the incomplete quaternion
        self._t_ns = 0
        self.messages = 0
        """Number of well-formed frames of this sensor."""
        self.incomplete = 0
        """Number of frames of quaternions whose other frames did not arrive in order and in
        time."""
        self.idle = 0
        """Number of frames of this sensor that contain no component of the quaternion."""
        self.foreign = 0
        """Number of frames of other devices."""

    def feed(self, frame: CanFrame) -> ChannelQuaternion | Heartbeat | CorruptBytes | None:
        """Return the content that `frame` completes; None if there is none."""
        t_ns, can_id, data, extended, error, remote = frame
        place = self._order.get(can_id)
        if extended or error or remote or (place is None and not self._is_mine(can_id)):
            self.foreign += 1
            return None

        if place is None:
            return self._other_frame(t_ns, can_id, data)
        if len(data) != FRAME_BYTES:
            reason = f"{len(data)} data bytes instead of {FRAME_BYTES}"
            return CorruptBytes(len(data), reason)

        self.messages += 1
        values = self._unpack(data)
        if place == 0:
            self.incomplete += self._received
            self._t_ns, self._values, self._received = t_ns, values, 1
        elif place == self._received and abs(t_ns - self._t_ns) <= self._longest_ns:
            # Frames arrive in order, but their stamps may differ by the error of two clock
            # readings.
            self._values += values
            self._received += 1
        else:
            self.incomplete += 1 + self._received
            self._received = 0
            return None

        if self._received < self._parts:
            return None
        self._received = 0
        values, (w, x, y, z) = self._values, self._places
        return ChannelQuaternion(self._t_ns, (values[w], values[x], values[y], values[z]))

    def flush(self) -> None:
        """Discard an incomplete quaternion."""
        self.incomplete += self._received
        self._received = 0

    def _is_mine(self, can_id: int) -> bool:
        return can_id in self._idle or can_id == self._heartbeat

    def _other_frame(self, t_ns: int, can_id: int, data: bytes) -> Heartbeat | CorruptBytes | None:
        """Return the content of a frame that contains no component of the quaternion."""
        if can_id == self._heartbeat:
            if not data:
                return CorruptBytes(0, "heartbeat without state")
            self.messages += 1
            return Heartbeat(t_ns, data[0])
        self.messages += 1
        self.idle += 1
        return None
