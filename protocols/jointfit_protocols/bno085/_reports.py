"""Reports of the sensor hub software SH-2, in both directions.

| report                        | bytes | values                            | unit of a count   |
|-------------------------------|-------|-----------------------------------|-------------------|
| 01 accelerometer              | 10    | x y z                             | 2^-8 m/s^2        |
| 02 gyroscope, calibrated      | 10    | x y z                             | 2^-9 rad/s        |
| 03 magnetic field, calibrated | 10    | x y z                             | 2^-4 uT           |
| 07 gyroscope, uncalibrated    | 16    | x y z, bias x y z                 | 2^-9 rad/s        |
| 14, 15 raw values             | 16    | x y z                             | counts of the ADC |
| 05, 28 rotation vector        | 14    | i j k real, accuracy (2^-12 rad)  | 2^-14             |
| 08, 29 game rotation vector   | 12    | i j k real                        | 2^-14             |
| 2A gyro rotation vector       | 14    | i j k real, rate x y z            | 2^-14, 2^-10 rad/s|

A sensor report begins with four fields: id, sequence, status and delay. Bits 0..1 of the status are
the accuracy, and bits 2..7 are the high bits of the delay. A packet begins with report FB, which
contains the time from a reference instant, the base, to the transmission of the packet. The delay
is the time from the base to the measurement. The delay and the times in FA and FB are in units of
100 us. The report FA shifts the base. Gyro rotation vectors are sent on a separate channel and
consist only of their values.

Sources: SH-2 reference manual 1000-3625. Lengths and the sign of times are from the vendor's host
library (sh2, Apache-2.0).
"""

from __future__ import annotations

import struct
from enum import IntEnum
from typing import NamedTuple

TICK_NS = 100_000
"""Unit of base times and delays, ns."""
ACCURACY = ("unreliable", "low", "medium", "high")
"""Names of the accuracy levels in bits 0 and 1 of the status."""
_HEAD = 4
_MOST_DELAY = (1 << 14) - 1


class HubReportId(IntEnum):
    """Ids of reports, which are their first byte."""

    ACCELEROMETER = 0x01
    GYROSCOPE = 0x02
    MAGNETIC_FIELD = 0x03
    ROTATION_VECTOR = 0x05
    GYROSCOPE_UNCALIBRATED = 0x07
    GAME_ROTATION_VECTOR = 0x08
    RAW_ACCELEROMETER = 0x14
    RAW_GYROSCOPE = 0x15
    ARVR_ROTATION_VECTOR = 0x28
    ARVR_GAME_ROTATION_VECTOR = 0x29
    GYRO_ROTATION_VECTOR = 0x2A
    PRODUCT_RESPONSE = 0xF8
    PRODUCT_REQUEST = 0xF9
    TIME_REBASE = 0xFA
    BASE_TIME = 0xFB
    FEATURE_RESPONSE = 0xFC
    SET_FEATURE = 0xFD
    FEATURE_REQUEST = 0xFE


ROTATION_REPORTS = (
    HubReportId.ROTATION_VECTOR,
    HubReportId.GAME_ROTATION_VECTOR,
    HubReportId.ARVR_ROTATION_VECTOR,
    HubReportId.ARVR_GAME_ROTATION_VECTOR,
)
"""Reports that contain an orientation."""

_Q4, _Q8, _Q9, _Q10, _Q12, _Q14 = (2.0**-bits for bits in (4, 8, 9, 10, 12, 14))
_SCALES: dict[int, tuple[float, ...]] = {
    HubReportId.ACCELEROMETER: (_Q8,) * 3,
    HubReportId.GYROSCOPE: (_Q9,) * 3,
    HubReportId.MAGNETIC_FIELD: (_Q4,) * 3,
    HubReportId.GYROSCOPE_UNCALIBRATED: (_Q9,) * 6,
    HubReportId.RAW_ACCELEROMETER: (1.0,) * 3,
    HubReportId.RAW_GYROSCOPE: (1.0,) * 3,
    HubReportId.ROTATION_VECTOR: (*(_Q14,) * 4, _Q12),
    HubReportId.ARVR_ROTATION_VECTOR: (*(_Q14,) * 4, _Q12),
    HubReportId.GAME_ROTATION_VECTOR: (_Q14,) * 4,
    HubReportId.ARVR_GAME_ROTATION_VECTOR: (_Q14,) * 4,
}
"""Value of one count, for each field of each report, in the units of the table at the top of this
module."""
_LENGTHS: dict[int, int] = {
    0x01: 10, 0x02: 10, 0x03: 10, 0x04: 10, 0x05: 14, 0x06: 10, 0x07: 16, 0x08: 12, 0x09: 14,
    0x0A: 8, 0x0B: 8, 0x0C: 6, 0x0D: 6, 0x0E: 6, 0x0F: 16, 0x10: 5, 0x11: 12, 0x12: 6, 0x13: 6,
    0x14: 16, 0x15: 16, 0x16: 16, 0x18: 8, 0x19: 6, 0x1A: 6, 0x1B: 8, 0x1C: 6, 0x1E: 16, 0x1F: 6,
    0x20: 6, 0x21: 6, 0x22: 6, 0x23: 6, 0x28: 14, 0x29: 12, 0x2A: 14, 0x2B: 6, 0x2C: 24, 0x2D: 60,
    0x2E: 12,
    0xEF: 2, 0xF1: 16, 0xF3: 16, 0xF5: 4, 0xF8: 16, 0xFA: 5, 0xFB: 5, 0xFC: 17,
}  # fmt: skip
"""Length of each report, bytes."""
_FORMATS = {kind: struct.Struct(f"<{len(scales)}h") for kind, scales in _SCALES.items()}
_GYRO_ROTATION = struct.Struct("<7h")
_GYRO_ROTATION_SCALES = (*(_Q14,) * 4, *(_Q10,) * 3)
_BASE = struct.Struct("<Bi")
_FEATURE = struct.Struct("<BBBHIII")
_PRODUCT = struct.Struct("<BBBBIIHH")


class HubReport(NamedTuple):
    """One measurement of a sensor."""

    report_id: int
    sequence: int
    """Sequence number of the report for this sensor, modulo 256."""
    status: int
    """Accuracy, from bits 0 and 1 of the status; an index of `ACCURACY`."""
    delay: int
    """Time from the base to the measurement, in units of 100 us."""
    values: tuple[float, ...]
    """Measured values, in the order and the units of the table at the top of this module."""


def split_reports(payload: bytes) -> list[bytes] | None:
    """Return the reports of a packet; None if they do not fill the packet, or if one is unknown."""
    reports, at, end = [], 0, len(payload)
    while at < end:
        size = _LENGTHS.get(payload[at])
        if size is None or at + size > end:
            return None
        reports.append(payload[at : at + size])
        at += size
    return reports


def unknown_report(payload: bytes) -> int | None:
    """Return the first byte of the first report of unknown length; None if there is none."""
    at = 0
    while at < len(payload):
        size = _LENGTHS.get(payload[at])
        if size is None:
            return payload[at]
        at += size
    return None


def decode_report(report: bytes) -> HubReport | None:
    """Return a measurement; None for other reports.

    `split_reports` must have checked the length.
    """
    kind = report[0]
    scales = _SCALES.get(kind)
    if scales is None:
        return None
    counts = _FORMATS[kind].unpack_from(report, _HEAD)
    delay = (report[2] & 0xFC) << 6 | report[3]
    values = tuple(count * scale for count, scale in zip(counts, scales, strict=True))
    return HubReport(kind, report[1], report[2] & 3, delay, values)


def decode_gyro_rotations(payload: bytes) -> list[tuple[float, ...]] | None:
    """Return each gyro rotation vector of a packet: i j k real, and the angular rate x y z, rad/s.

    Return None if the vectors do not fill the packet.
    """
    if not payload or len(payload) % _GYRO_ROTATION.size:
        return None
    return [
        tuple(count * scale for count, scale in zip(counts, _GYRO_ROTATION_SCALES, strict=True))
        for counts in _GYRO_ROTATION.iter_unpack(payload)
    ]


def encode_gyro_rotation(values: tuple[float, ...]) -> bytes:
    """Return the bytes of one gyro rotation vector. Values out of range are clipped."""
    counts = [round(v / s) for v, s in zip(values, _GYRO_ROTATION_SCALES, strict=True)]
    return _GYRO_ROTATION.pack(*(max(-32768, min(32767, count)) for count in counts))


def encode_report(report: HubReport) -> bytes:
    """Return a measurement as bytes. Values out of range are clipped."""
    scales = _SCALES[report.report_id]
    counts = [round(v / s) for v, s in zip(report.values, scales, strict=True)]
    limited = [max(-32768, min(32767, count)) for count in counts]
    delay = min(report.delay, _MOST_DELAY)
    status = delay >> 6 & 0xFC | report.status
    head = bytes((report.report_id, report.sequence & 0xFF, status, delay & 0xFF))
    body = head + _FORMATS[report.report_id].pack(*limited)
    return body.ljust(_LENGTHS[report.report_id], b"\0")


def base_time(report: bytes) -> int | None:
    """Return the shift of the base by a report FB or FA, in units of 100 us; None for others."""
    if report[0] not in {HubReportId.BASE_TIME, HubReportId.TIME_REBASE}:
        return None
    kind, value = _BASE.unpack(report)
    shift: int = -value if kind == HubReportId.BASE_TIME else value
    return shift


def encode_base_time(age: int) -> bytes:
    """Return a report FB, which states that the base was `age` × 100 us before transmission."""
    return _BASE.pack(HubReportId.BASE_TIME, age)


def product_request() -> bytes:
    """Return the request for the product id."""
    return bytes((HubReportId.PRODUCT_REQUEST, 0))


def feature_request(report_id: int) -> bytes:
    """Return the request for the settings of a report."""
    return bytes((HubReportId.FEATURE_REQUEST, report_id))


def encode_feature(report_id: int, interval_us: int, *, response: bool = False) -> bytes:
    """Return the command that sets the interval of a report, us, or the response to this command.

    An interval of 0 switches the report off. The settings are lost at a reset.
    """
    kind = HubReportId.FEATURE_RESPONSE if response else HubReportId.SET_FEATURE
    return _FEATURE.pack(kind, report_id, 0, 0, interval_us, 0, 0)


def decode_interval(report: bytes) -> tuple[int, int] | None:
    """Return the report id and the interval, us, of a feature report; None for other bytes."""
    if len(report) != _FEATURE.size or report[0] not in {
        HubReportId.FEATURE_RESPONSE,
        HubReportId.SET_FEATURE,
    }:
        return None
    fields = _FEATURE.unpack(report)
    return fields[1], fields[4]


def encode_firmware(version: tuple[int, int, int], part: int, build: int) -> bytes:
    """Return a product id response."""
    major, minor, patch = version
    return _PRODUCT.pack(HubReportId.PRODUCT_RESPONSE, 1, major, minor, part, build, patch, 0)


def decode_firmware(report: bytes) -> tuple[tuple[int, int, int], int, int] | None:
    """Return version, part number and build of a product id response; None for other bytes."""
    if len(report) != _PRODUCT.size or report[0] != HubReportId.PRODUCT_RESPONSE:
        return None
    _, _, major, minor, part, build, patch, _ = _PRODUCT.unpack(report)
    return (major, minor, patch), part, build
