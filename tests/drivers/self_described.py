"""Tables of rig.toml that describe devices, and virtual devices that send data in these formats."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from jointfit_daemon.driver import CanBusSettings
from jointfit_drivers.can_table import CanTableSettings
from jointfit_drivers.serial_table import SerialTableSettings
from jointfit_protocols.table import SLOTS
from jointfit_simulators.devices import (
    CanTablePort,
    SerialTablePort,
    TableDevice,
    TableDeviceOptions,
)

if TYPE_CHECKING:
    from jointfit_simulators.imu_device import WireNoise
    from jointfit_simulators.wires import CanWire

INTEGERS = {
    "frame": {"sync": "AA 55", "length": 18, "checksum": {"kind": "sum8", "first": 2}},
    "fields": {
        "counter": {"offset": 2, "type": "u8"},
        "time": {"offset": 3, "type": "u32", "unit": "us"},
        "quaternion": {"offset": 7, "type": "i16", "divisor": 32767},
        "valid": {"offset": 15, "type": "u8"},
    },
    "world": "NED",
}
FLOATS = {
    "byte_order": "big",
    "frame": {
        "sync": "B5 62",
        "length_field": {"offset": 2, "type": "u16", "adds": 6, "longest": 64},
        "message": {"offset": 4, "equals": 7},
        "checksum": {"kind": "crc16", "init": 0xFFFF},
    },
    "fields": {
        "time": {"offset": 5, "type": "f64", "unit": "s"},
        "quaternion": {"offset": 13, "type": "f32", "order": "xyzw"},
    },
    "world": "NWU",
    "direction": "world_to_sensor",
}
LINES = {
    "text": {"prefix": "$Q,", "columns": 6, "checksum": {"kind": "xor8", "first": 1}},
    "fields": {
        "time": {"column": 1, "unit": "us"},
        "counter": {"column": 2},
        "quaternion": {"column": 3},
    },
}
CSV = {
    "text": {},
    "fields": {"time": {"column": 1, "unit": "ms"}, "quaternion": {"column": 2}},
}
SBG = {
    "ids": {"time": 0x130, "quaternion": 0x131},
    "fields": {
        "time": {"offset": 0, "type": "u32", "unit": "us"},
        "quaternion": {"offset": 0, "type": "i16", "divisor": 32767},
    },
    "world": "NED",
}
HALVES = {
    "ids": {"first": 0x19FF0010, "second": 0x19FF0011},
    "extended_ids": True,
    "fields": {
        "quaternion": [
            {"frame": "first", "offset": 0, "type": "f32", "order": "wx"},
            {"frame": "second", "offset": 0, "type": "f32", "order": "yz"},
        ]
    },
    "world": "NWU",
    "direction": "world_to_sensor",
}
PAGES = HALVES | {
    "ids": {"first": 0x200, "second": 0x200},
    "starts_with": {"first": "55 01", "second": "55 02"},
    "extended_ids": False,
    "fields": {
        "quaternion": [
            {"frame": "first", "offset": 2, "type": "i24", "divisor": 8388607, "order": "wx"},
            {"frame": "second", "offset": 2, "type": "i24", "divisor": 8388607, "order": "yz"},
        ]
    },
}
ONE_FRAME = {
    "ids": {"quaternion": 0x181},
    "byte_order": "big",
    "fields": {"quaternion": {"offset": 0, "type": "i16", "divisor": 32767}},
}


def serial_settings(port: Path | str, table: dict[str, Any], **more: Any) -> SerialTableSettings:
    head = {"id": "S1", "segment": "shank", "driver": "serial-table", "silence_s": 0.4}
    return SerialTableSettings.model_validate(head | {"port": str(port)} | table | more)


def can_settings(interface: str, channel: str, table: dict[str, Any]) -> CanTableSettings:
    bus = CanBusSettings(interface=interface, channel=channel)
    head = {"id": "S2", "segment": "shank", "driver": "can-table", "silence_s": 0.4, "can": bus}
    return CanTableSettings.model_validate(head | table)


def device_options(
    settings: SerialTableSettings | CanTableSettings, **more: Any
) -> TableDeviceOptions:
    """Return the options of a device that sends what a table describes."""
    fields = settings.places().fields
    if isinstance(settings, SerialTableSettings) and settings.text is not None:
        for name in ("time", "counter"):  # whole numbers, as an Arduino program prints them
            (slot,) = SLOTS[name]
            if slot in fields:
                fields[slot] = fields[slot]._replace(kind="u")
    return TableDeviceOptions(
        fields,
        settings.rate_hz,
        settings.world,
        settings.direction == "world_to_sensor",
        **more,
    )


def serial_device(settings: SerialTableSettings, wire_noise: WireNoise, **more: Any) -> TableDevice:
    port = SerialTablePort(Path(settings.port), settings.wire_format(), wire_noise)
    return TableDevice(port, device_options(settings, **more))


def can_device(settings: CanTableSettings, wire: CanWire, **more: Any) -> TableDevice:
    return TableDevice(CanTablePort(wire, settings.can_table()), device_options(settings, **more))
