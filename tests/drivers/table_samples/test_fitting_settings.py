"""Warnings about wrong byte order, type, scale and units of a table, found from the data."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import Chunk, DeviceEvent, ImuSample
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import TableDevice
from tests.drivers.self_described import device_options, serial_settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_drivers.serial_table import SerialTableSettings

from jointfit_protocols.table import LineFormat, encode_frame, encode_line

PERIOD_NS = 10_000_000
FRAME = {"sync": "AA 55", "length": 40, "checksum": {"kind": "crc16"}}
RAW: dict[str, Any] = {
    "frame": FRAME,
    "fields": {
        "time": {"offset": 2, "type": "u32", "unit": "us"},
        "quaternion": {"offset": 6, "type": "i16", "divisor": 16384},
        "rate": {"offset": 14, "type": "i16", "divisor": 900, "unit": "rad/s"},
        "acceleration": {"offset": 20, "type": "i16", "divisor": 4096, "unit": "g"},
    },
}


class MemoryPort:
    """Port that stores the messages of a device."""

    is_open, line_ns = True, 0

    def __init__(self, settings: SerialTableSettings) -> None:
        self._wire = settings.wire_format()
        self.messages: list[bytes] = []

    def send(self, values: Sequence[float]) -> bool:
        wire = self._wire
        encoded = encode_line(wire, values) if isinstance(wire, LineFormat) else None
        self.messages.append(encoded or encode_frame(wire, values))  # type: ignore[arg-type]
        return True

    def send_text(self, text: bytes) -> None: ...
    def unplug(self) -> None: ...
    def plug(self) -> None: ...
    async def run(self) -> None: ...


def messages_of(settings: SerialTableSettings, count: int = 400) -> list[bytes]:
    """Return the messages of a moving device at 100 Hz."""
    port = MemoryPort(settings)
    device = TableDevice(port, device_options(settings))
    for number in range(count):
        device.push(number * PERIOD_NS, orientation(number // 4))
    return port.messages


def decoded(table: dict[str, Any], messages: list[bytes]) -> list[Any]:
    driver = find_driver("serial-table")
    decoder = driver(serial_settings("/dev/ttyUSB0", table)).decoder()
    chunks = [Chunk((1 + at) * PERIOD_NS, data) for at, data in enumerate(messages)]
    return [item for chunk in chunks for item in decoder.feed(chunk)]


def warnings_with(changes: dict[str, dict[str, Any]]) -> list[str]:
    """Return the warnings of a driver whose table differs in the keys of `changes`."""
    fields = {name: keys | changes.get(name, {}) for name, keys in RAW["fields"].items()}
    messages = messages_of(serial_settings("/dev/ttyUSB0", RAW))
    items = decoded(RAW | {"fields": fields}, messages)
    return [item.text for item in items if isinstance(item, DeviceEvent)]


def test_a_correct_table_causes_no_warning() -> None:
    assert warnings_with({}) == []


@pytest.mark.parametrize(
    ("changes", "fitting"),
    [
        ({"quaternion": {"byte_order": "big"}}, 'fields.quaternion with byte_order = "little"'),
        ({"quaternion": {"divisor": 32767}}, "fields.quaternion with divisor = 16384"),
        (
            {"quaternion": {"byte_order": "big", "divisor": 1000}},
            'fields.quaternion with byte_order = "little", divisor = 16384',
        ),
        ({"quaternion": {"type": "u16"}}, 'fields.quaternion with type = "i16"'),
        ({"acceleration": {"unit": "m/s2"}}, 'acceleration with unit = "g", divisor = 4096'),
        ({"acceleration": {"divisor": 1000}}, 'acceleration with unit = "g", divisor = 4096'),
        ({"acceleration": {"byte_order": "big"}}, 'acceleration with byte_order = "little"'),
        ({"rate": {"unit": "deg/s"}}, 'the data fit fields.rate with unit = "rad/s"'),
        ({"time": {"unit": "100us"}}, "device time advances 100 times as fast"),
    ],
    ids=str,
)
def test_a_wrong_key_is_reported_with_the_one_that_fits(
    changes: dict[str, dict[str, Any]], fitting: str
) -> None:
    (warning,) = [text for text in warnings_with(changes) if "lost" not in text]
    assert fitting in warning


def test_a_wrong_offset_has_no_fitting_scale() -> None:
    table = RAW | {"fields": {"quaternion": {"offset": 15, "type": "i16", "divisor": 16384}}}
    messages = messages_of(serial_settings("/dev/ttyUSB0", RAW))
    (warning,) = [item for item in decoded(table, messages) if isinstance(item, DeviceEvent)]
    assert "check offset, type, byte order and scale of `fields.quaternion`" in warning.text


def test_the_wrong_scale_of_text_lines_is_reported() -> None:
    table = {"text": {}, "fields": {"quaternion": {"column": 1, "divisor": 100}}}
    lines = [b"10000,0,0,0\r\n"] * 150
    (warning,) = [item for item in decoded(table, lines) if isinstance(item, DeviceEvent)]
    assert "norm of the quaternion is 100, expected 1" in warning.text
    assert "fields.quaternion with divisor = 10000" in warning.text


def test_floats_in_the_wrong_byte_order_are_recognized() -> None:
    table = {
        "frame": {"sync": "AA 55", "length": 19, "checksum": {"kind": "sum8"}},
        "fields": {"quaternion": {"offset": 2, "type": "f32", "byte_order": "big"}},
    }
    frames = []
    for number in range(120):
        body = b"\xaa\x55" + struct.pack("<4f", *orientation(number))
        frames.append(body + bytes((sum(body) & 0xFF,)))
    items = decoded(table, frames)
    assert not any(isinstance(item, ImuSample) for item in items)
    (warning,) = [item for item in items if isinstance(item, DeviceEvent)]
    assert 'fields.quaternion with byte_order = "little"' in warning.text
