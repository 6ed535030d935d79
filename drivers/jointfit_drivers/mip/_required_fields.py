"""Fields that a MIP device must send, by the source of its orientation.

All fields, including the time, belong to one data set and need the same decimation. Otherwise a
packet may contain an orientation without time, because each field has a separate decimation.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.mip.data import (
    DataSet,
    FilterField,
    SensorField,
    SharedField,
    field_bytes,
)

if TYPE_CHECKING:
    from jointfit_protocols.mip.commands import Family

_FRAME_BYTES = 6
"""Framing of a packet, bytes."""
QUATERNIONS = {DataSet.SENSOR: SensorField.QUATERNION, DataSet.FILTER: FilterField.QUATERNION}
GPS_TIMES = {DataSet.SENSOR: SensorField.GPS_TIME, DataSet.FILTER: FilterField.GPS_TIME}
RAW = (SensorField.ACCELERATION, SensorField.ANGULAR_RATE)


class RequiredFields(NamedTuple):
    """Fields of one data set."""

    data_set: DataSet
    measured: tuple[int, ...]
    """Fields with measurements."""

    def with_time(self, family: Family) -> tuple[int, ...]:
        """Return all fields, the time of this family first."""
        legacy = family == "legacy"
        return (GPS_TIMES[self.data_set] if legacy else SharedField.REFERENCE_TIME, *self.measured)

    @property
    def packet_bytes(self) -> int:
        """Size of the smallest sufficient packet of a legacy device, bytes; others are smaller."""
        fields = self.with_time("legacy")
        return _FRAME_BYTES + sum(field_bytes(self.data_set, field) for field in fields)


def required_fields(orientation: str, estimator: str, *, magnetometer: bool) -> RequiredFields:
    """Return the fields that a device with these settings must send.

    Parameters
    ----------
    orientation : {"device", "gateway"}
        Where the orientation is computed.
    estimator : {"filter", "sensor"}
        Which of the device's two orientations is used.
    magnetometer : bool
        Whether the gateway uses the magnetometer.
    """
    if orientation == "gateway":
        field = (SensorField.MAGNETIC_FIELD,) if magnetometer else ()
        return RequiredFields(DataSet.SENSOR, (*RAW, *field))
    data_set = DataSet.FILTER if estimator == "filter" else DataSet.SENSOR
    return RequiredFields(data_set, (QUATERNIONS[data_set],))
