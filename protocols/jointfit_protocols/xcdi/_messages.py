"""CAN messages of the protocol XCDI of Xsens MTi-600, Sirius and Avior, in both directions.

Every quantity is sent in a separate frame. The frames of one sensor at one instant form a group:

    SampleTime  GroupCounter  ...  Quaternion        lowest identifier first
    U4 ticks    U2            ...  4 x I2 / 32767, w x y z, sensor to world, ENU

U2 and U4 are unsigned integers of 2 and 4 bytes, and I2 is a signed integer of 2 bytes. Frames of
other sensors may arrive in between, so groups are assembled separately for each sensor.
Identifiers can be configured. By default, they are the data identifiers, but any 11- or 29-bit
value is possible.

Source: Xsens MT1604P rev. A (2019) and the vendor's CAN pages. The byte order is from third-party
decoders. The sources disagree on the unit of SampleTime (100 us or 1 us); see `TickUnit`.

Invariant: the codec converts frames to counts. It uses no bus and no clock.
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import Literal, NamedTuple

from jointfit_protocols.can import STANDARD_MAX, CanFrame
from jointfit_protocols.corrupt import CorruptBytes

ByteOrder = Literal["big", "little"]

TICKS_MODULUS = 2**32
"""Number of ticks after which SampleTime wraps."""
COUNTER_MODULUS = 2**16
"""Number of groups after which GroupCounter wraps."""
QUATERNION_SCALE = 1 / 32767
"""Value of one count. The count 0x8000 is -1.00003, which must be normalised and not rejected."""
OVERFLOW = 1
"""Error code for an overflow of the output buffer, in which at least one frame is lost."""


class DataId(IntEnum):
    """Content of a frame. It is also the identifier of the frame unless configured otherwise."""

    ERROR = 0x01
    SAMPLE_TIME = 0x05
    GROUP_COUNTER = 0x06
    UTC = 0x07
    STATUS_WORD = 0x11
    QUATERNION = 0x21
    EULER = 0x22
    RATE_OF_TURN = 0x32
    ACCELERATION = 0x34
    FREE_ACCELERATION = 0x35


class XcdiLayout(NamedTuple):
    """Layout of a message."""

    fields: str
    """``struct`` codes of the fields, without byte order."""
    scale: float
    """SI value of one count; for EULER, degrees per count."""
    unit: str


_LAYOUTS: dict[DataId, XcdiLayout] = {
    DataId.ERROR: XcdiLayout("B", 1, ""),
    DataId.SAMPLE_TIME: XcdiLayout("I", 1, "ticks"),
    DataId.GROUP_COUNTER: XcdiLayout("H", 1, ""),
    DataId.UTC: XcdiLayout("6BH", 1, "year - 2000, month, day, hour, minute, second, 100 us"),
    DataId.STATUS_WORD: XcdiLayout("I", 1, "bits"),
    DataId.QUATERNION: XcdiLayout("4h", QUATERNION_SCALE, ""),
    DataId.EULER: XcdiLayout("3h", 1 / 128, "deg"),
    DataId.RATE_OF_TURN: XcdiLayout("3h", 1 / 512, "rad/s"),
    DataId.ACCELERATION: XcdiLayout("3h", 1 / 256, "m/s^2"),
    DataId.FREE_ACCELERATION: XcdiLayout("3h", 1 / 256, "m/s^2"),
}
_STRUCTS: dict[ByteOrder, dict[DataId, struct.Struct]] = {
    "big": {key: struct.Struct(">" + layout.fields) for key, layout in _LAYOUTS.items()},
    "little": {key: struct.Struct("<" + layout.fields) for key, layout in _LAYOUTS.items()},
}


def layout(data_id: DataId) -> XcdiLayout:
    """Return the layout of messages with the content `data_id`."""
    return _LAYOUTS[data_id]


def decode(
    data_id: DataId, data: bytes, byte_order: ByteOrder = "big"
) -> tuple[int, ...] | CorruptBytes:
    """Return the counts in the data field of a message, in wire order; never raise."""
    message = _STRUCTS[byte_order][data_id]
    if len(data) != message.size:
        return CorruptBytes(
            len(data), f"{data_id.name}: {len(data)} data bytes instead of {message.size}"
        )
    return message.unpack(data)


def encode(data_id: DataId, counts: tuple[int, ...], byte_order: ByteOrder = "big") -> bytes:
    """Return the data field of a message.

    Raises
    ------
    struct.error
        A count does not fit into its field, or the number of counts is wrong.
    """
    return _STRUCTS[byte_order][data_id].pack(*counts)


def quaternion_counts(q: tuple[float, float, float, float]) -> tuple[int, int, int, int]:
    """Return the counts that a device sends for the unit quaternion `q` (w, x, y, z)."""
    w, x, y, z = (max(-32768, min(32767, round(part * 32767))) for part in q)
    return w, x, y, z


class XcdiIds(NamedTuple):
    """Identifiers of one sensor; None for frames that are not received."""

    sample_time: int | None = int(DataId.SAMPLE_TIME)
    group_counter: int | None = int(DataId.GROUP_COUNTER)
    quaternion: int = int(DataId.QUATERNION)
    status_word: int | None = int(DataId.STATUS_WORD)
    error: int | None = int(DataId.ERROR)
    extended: bool = False
    """Whether identifiers have 29 bits, even if the numbers would fit into 11 bits."""

    def by_id(self) -> dict[tuple[int, bool], DataId]:
        """Return the content of each identifier; a key is (number, whether it has 29 bits)."""
        return {
            (number, self.extended or number > STANDARD_MAX): DataId[name.upper()]
            for name, number in self._asdict().items()
            if name != "extended" and number is not None
        }


def id_block(base: int, *, extended: bool = False) -> XcdiIds:
    """Return the identifiers of a sensor: all data identifiers increased by `base`."""
    return XcdiIds(
        sample_time=base + DataId.SAMPLE_TIME,
        group_counter=base + DataId.GROUP_COUNTER,
        quaternion=base + DataId.QUATERNION,
        status_word=base + DataId.STATUS_WORD,
        error=base + DataId.ERROR,
        extended=extended,
    )


class XcdiGroup(NamedTuple):
    """One orientation, and the other values of its group, as sent."""

    t_ns: int
    """Stamp of the first frame of the group, ns; of the Quaternion frame if SampleTime is
    missing."""
    ticks: int | None
    """SampleTime; None if the group had none."""
    counter: int | None
    status: int | None
    quaternion: tuple[int, int, int, int]
    """Counts of 1/32767 in the order w x y z."""


class XcdiError(NamedTuple):
    """An error that the device reported."""

    t_ns: int
    code: int
    """Error code. 1 means that the output buffer overflowed, so that at least one frame is lost."""


XcdiMessage = XcdiGroup | XcdiError | CorruptBytes


_QUATERNION, _SAMPLE_TIME = DataId.QUATERNION, DataId.SAMPLE_TIME
_GROUP_COUNTER, _ERROR = DataId.GROUP_COUNTER, DataId.ERROR


class XcdiCodec:
    """Codec that converts one sensor's frames to groups; it never raises.

    SampleTime opens a group, and Quaternion completes it. If a second SampleTime or GroupCounter
    arrives before the Quaternion, the open group counts as incomplete. A Quaternion without an open
    group has no device time, but it may have a counter. Frames with other identifiers are counted
    and ignored.

    Parameters
    ----------
    ids : XcdiIds
        Identifiers of the sensor.
    byte_order : ByteOrder
        Byte order of the payloads.
    """

    def __init__(self, ids: XcdiIds, byte_order: ByteOrder = "big") -> None:
        self._by_id = ids.by_id()
        self._messages = _STRUCTS[byte_order]
        self._start_ns = 0
        self._ticks: int | None = None  # values of the open group
        self._counter: int | None = None
        self._status: int | None = None
        self.messages = 0
        """Number of well-formed frames of this sensor."""
        self.incomplete = 0
        """Number of groups without a Quaternion."""
        self.ungrouped = 0
        """Number of Quaternions without an open group, because SampleTime was lost or is not
        sent."""
        self.foreign = 0
        """Number of frames of other devices."""

    def feed(self, frame: CanFrame) -> XcdiMessage | None:
        """Return the message that `frame` completes; None if it completes none."""
        t_ns, can_id, data, extended, error, remote = frame
        data_id = self._by_id.get((can_id, extended))
        if data_id is None or error or remote:
            self.foreign += 1
            return None
        message = self._messages[data_id]
        if len(data) != message.size:
            size = f"{len(data)} data bytes instead of {message.size}"
            return CorruptBytes(len(data), f"{data_id.name}: {size}")

        self.messages += 1
        counts = message.unpack(data)
        if data_id is _QUATERNION:
            if self._ticks is None:
                self.ungrouped += 1
                self._start_ns = t_ns
            group = XcdiGroup(self._start_ns, self._ticks, self._counter, self._status, counts)
            self._ticks = self._counter = self._status = None
            return group

        if data_id is _SAMPLE_TIME:
            self._open(t_ns, counts[0])
        elif data_id is _GROUP_COUNTER:
            if self._counter is not None:
                self._open(t_ns, None)  # its SampleTime was lost
            self._counter = counts[0]
        elif data_id is _ERROR:
            return XcdiError(t_ns, counts[0])
        else:
            self._status = counts[0]
        return None

    def flush(self) -> None:
        """Discard an incomplete group."""
        self._open(0, None)

    def _open(self, t_ns: int, ticks: int | None) -> None:
        if self._ticks is not None or self._counter is not None:
            self.incomplete += 1
        self._start_ns, self._ticks = t_ns, ticks
        self._counter = self._status = None
