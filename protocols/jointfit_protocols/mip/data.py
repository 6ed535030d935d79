"""Fields of MIP data packets. Values are returned as sent, without conversion of units.

| set, field  | values                                                                        |
|-------------|-------------------------------------------------------------------------------|
| any, 0xD0   | event source: 0 scheduled, otherwise the number of a trigger                  |
| any, 0xD3   | GPS time of week s, week, flags: 1 time of week valid, 2 week valid           |
| any, 0xD5   | reference time, ns since start; monotonic                                     |
| any, 0xD6   | ns since the previous field 0xD6                                              |
| any, 0xD7   | external time ns, flag: valid                                                 |
| 0x80, 0x04  | acceleration (specific force), g                                              |
| 0x80, 0x05  | angular rate, rad/s                                                           |
| 0x80, 0x06  | magnetic field, gauss                                                         |
| 0x80, 0x0A  | quaternion w x y z of the complementary filter                                |
| 0x80, 0x0C  | roll, pitch, yaw of the complementary filter, rad                             |
| 0x80, 0x12  | as any, 0xD3; without a pulse per second, the time of week is device time     |
| 0x82, 0x03  | quaternion w x y z of the estimation filter, flags: 1 valid                   |
| 0x82, 0x05  | roll, pitch, yaw of the estimation filter, rad, flags: 1 valid                |
| 0x82, 0x10  | filter state, dynamics mode, flags                                            |
| 0x82, 0x11  | as 0x80, 0x12                                                                 |

The quaternion converts vehicle to NED coordinates. The vehicle frame equals the sensor frame unless
a transform is stored in the device.

Source: definitions of the vendor's mip_sdk (MIT).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jointfit_protocols.mip._framing import MipField


class DataSet(IntEnum):
    """Descriptor sets that contain data."""

    SENSOR = 0x80
    FILTER = 0x82
    SYSTEM = 0xA0


class SharedField(IntEnum):
    """Fields that every data set may contain."""

    EVENT_SOURCE = 0xD0
    GPS_TIME = 0xD3
    REFERENCE_TIME = 0xD5
    REFERENCE_TIME_STEP = 0xD6
    EXTERNAL_TIME = 0xD7


class SensorField(IntEnum):
    """Fields of the data set 0x80."""

    ACCELERATION = 0x04
    ANGULAR_RATE = 0x05
    MAGNETIC_FIELD = 0x06
    QUATERNION = 0x0A
    EULER_ANGLES = 0x0C
    GPS_TIME = 0x12


class FilterField(IntEnum):
    """Fields of the data set 0x82."""

    QUATERNION = 0x03
    EULER_ANGLES = 0x05
    STATUS = 0x10
    GPS_TIME = 0x11


WEEK_NS = 7 * 86_400 * 1_000_000_000
"""Duration of a GPS week, ns."""
_MOST_SECONDS = 1e9
"""Upper limit of a plausible time of week, s. Without GPS, it is the time since the start."""
STANDARD_GRAVITY = 9.80665
"""One g of the accelerometer, m/s^2."""

_GPS = struct.Struct(">dHH")
_VECTOR = struct.Struct(">3f")
_SHARED = {
    int(SharedField.EVENT_SOURCE): struct.Struct(">B"),
    int(SharedField.GPS_TIME): _GPS,
    int(SharedField.REFERENCE_TIME): struct.Struct(">Q"),
    int(SharedField.REFERENCE_TIME_STEP): struct.Struct(">Q"),
    int(SharedField.EXTERNAL_TIME): struct.Struct(">QH"),
}
_LAYOUTS: dict[int, dict[int, struct.Struct]] = {
    DataSet.SENSOR: {
        SensorField.ACCELERATION: _VECTOR,
        SensorField.ANGULAR_RATE: _VECTOR,
        SensorField.MAGNETIC_FIELD: _VECTOR,
        SensorField.QUATERNION: struct.Struct(">4f"),
        SensorField.EULER_ANGLES: _VECTOR,
        SensorField.GPS_TIME: _GPS,
        **_SHARED,
    },
    DataSet.FILTER: {
        FilterField.QUATERNION: struct.Struct(">4fH"),
        FilterField.EULER_ANGLES: struct.Struct(">3fH"),
        FilterField.STATUS: struct.Struct(">3H"),
        FilterField.GPS_TIME: _GPS,
        **_SHARED,
    },
}


_SHARED_FIELDS = range(0xD0, 0xD9)
_KNOWN_FIELDS: dict[int, tuple[range, ...]] = {
    DataSet.SENSOR: (range(0x01, 0x19), range(0x40, 0x41), _SHARED_FIELDS),
    DataSet.FILTER: (range(0x01, 0x52), _SHARED_FIELDS),
}
_KNOWN_SETS = frozenset((0x80, 0x81, 0x82, 0x90, 0x91, 0x92, 0x93, 0x94, 0x95, 0xA0))


def known_fields(descriptor_set: int) -> frozenset[int] | None:
    """Return the documented fields of a data set; None if the set itself is not documented.

    The fields of sets without orientations are not listed, so all of them count as documented.
    """
    if descriptor_set not in _KNOWN_SETS:
        return None
    ranges = _KNOWN_FIELDS.get(descriptor_set, (range(0x100),))
    return frozenset(field for each in ranges for field in each)


def decode_field(descriptor_set: int, descriptor: int, data: bytes) -> tuple[Any, ...] | None:
    """Return the values of a field; None if it is unknown or its size is wrong."""
    layout = _LAYOUTS.get(descriptor_set, _SHARED).get(descriptor)
    if layout is None or len(data) != layout.size:
        return None
    return layout.unpack(data)


def encode_field(descriptor_set: int, descriptor: int, *values: float) -> MipField:
    """Return a field.

    Raises
    ------
    KeyError
        The field is unknown.
    struct.error
        The values do not fit the field.
    """
    layout = _LAYOUTS.get(descriptor_set, _SHARED)[descriptor]
    return descriptor, layout.pack(*values)


def field_bytes(descriptor_set: int, descriptor: int) -> int:
    """Return the size of a known field in a packet, bytes."""
    return _LAYOUTS.get(descriptor_set, _SHARED)[descriptor].size + 2


def gps_ns(week: int, time_of_week_s: float) -> int | None:
    """Return GPS time as a single number, ns; None if the time of week is implausible."""
    if not 0.0 <= time_of_week_s < _MOST_SECONDS:  # NaN compares false
        return None
    return week * WEEK_NS + round(time_of_week_s * 1e9)
