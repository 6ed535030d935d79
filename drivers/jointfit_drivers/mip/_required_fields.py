"""Fields that a MIP device must send. They depend on the source of the orientation.

All fields, including the time, belong to one data set and need the same decimation. With different
decimations, a packet could contain an orientation without time.
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
"""Size of the framing of a packet, bytes."""
QUATERNIONS = {DataSet.SENSOR: SensorField.QUATERNION, DataSet.FILTER: FilterField.QUATERNION}
GPS_TIMES = {DataSet.SENSOR: SensorField.GPS_TIME, DataSet.FILTER: FilterField.GPS_TIME}
RAW = (SensorField.ACCELERATION, SensorField.ANGULAR_RATE)


class RequiredFields(NamedTuple):
    """Required fields of one data set."""

    data_set: DataSet
    measured: tuple[int, ...]
    """Fields that contain measurements."""

    def with_time(self, family: Family) -> tuple[int, ...]:
        """Return all required fields, beginning with the time field of this family."""
        legacy = family == "legacy"
        return (GPS_TIMES[self.data_set] if legacy else SharedField.REFERENCE_TIME, *self.measured)

    @property
    def packet_bytes(self) -> int:
        """Size of a packet with the required fields of a legacy device, bytes.

        The packets of current devices are smaller.
        """
        fields = self.with_time("legacy")
        return _FRAME_BYTES + sum(field_bytes(self.data_set, field) for field in fields)


def required_fields(orientation: str, estimator: str, *, magnetometer: bool) -> RequiredFields:
    """Return the fields that a device with these settings must send.

    Parameters
    ----------
    orientation : {"device", "gateway"}
        Place where the orientation is computed.
    estimator : {"filter", "sensor"}
        Selects one of the two orientations that the device computes.
    magnetometer : bool
        Whether the gateway uses the magnetometer.
    """
    if orientation == "gateway":
        field = (SensorField.MAGNETIC_FIELD,) if magnetometer else ()
        return RequiredFields(DataSet.SENSOR, (*RAW, *field))
    data_set = DataSet.FILTER if estimator == "filter" else DataSet.SENSOR
    return RequiredFields(data_set, (QUATERNIONS[data_set],))
