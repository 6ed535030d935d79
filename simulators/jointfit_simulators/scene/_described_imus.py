"""IMUs of a scene whose messages a table describes; each sensor has its own table.

The table is in rig.toml and in the simulated device. The first two sensors send integers, in binary
frames or in a CAN frame that follows a frame with the time. The next two sensors send text lines,
or a quaternion of floats in two CAN frames. The following sensors repeat these formats.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.units import S_PER_US
from jointfit_protocols.table import (
    SLOTS,
    CanTable,
    Checksum,
    FrameFormat,
    LineFormat,
    TableField,
)
from jointfit_simulators.devices import (
    CanTablePort,
    SerialTablePort,
    TableDevice,
    TableDeviceOptions,
)

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_simulators.imu_device import WireNoise
    from jointfit_simulators.wires import CanWire

_COUNTS = 32767
"""Number of counts for 1 in quaternions of 16-bit integers."""
(_TIME,), (_COUNTER,) = SLOTS["time"], SLOTS["counter"]


def binary_frames(port: Path, rate_hz: float, noise: WireNoise) -> tuple[TableDevice, list[str]]:
    """Return a device that sends big-endian frames of 18 bytes, and its keys in rig.toml."""
    fields = {
        slot: TableField(8 + 2 * slot, "i", 16, "big", scale=1 / _COUNTS) for slot in range(4)
    }
    fields |= {
        _COUNTER: TableField(2, "u", 16, "big"),
        _TIME: TableField(4, "u", 32, "big", scale=S_PER_US),
    }
    checksum = Checksum("crc16", 2, "big", init=0xFFFF)
    wire = FrameFormat(b"\xaa\x55", fields, 18, checksum=checksum)
    options = TableDeviceOptions(fields, rate_hz, world="NED")
    keys = [
        f'port = "{port}"',
        "baud = 921600",
        'byte_order = "big"',
        'world = "NED"',
        'frame.sync = "AA 55"',
        "frame.length = 18",
        'frame.checksum = { kind = "crc16", first = 2, init = 0xFFFF }',
        'fields.counter = { offset = 2, type = "u16" }',
        'fields.time = { offset = 4, type = "u32", unit = "us" }',
        f'fields.quaternion = {{ offset = 8, type = "i16", divisor = {_COUNTS} }}',
    ]
    return TableDevice(SerialTablePort(port, wire, noise), options), keys


def text_lines(port: Path, rate_hz: float, noise: WireNoise) -> tuple[TableDevice, list[str]]:
    """Return a device that sends text lines like an Arduino sketch, and its keys in rig.toml."""
    columns = {0: 5, 1: 2, 2: 3, 3: 4, _TIME: 0, _COUNTER: 1}
    fields = {slot: TableField(column, "f", 64) for slot, column in columns.items()}
    fields[_TIME] = TableField(0, "u", 32, scale=S_PER_US)
    fields[_COUNTER] = TableField(1, "u", 32)
    wire = LineFormat(columns, prefix=b"$Q,", width=6, checksum=Checksum("xor8", 1, "big"))
    greeting = b"\r\nBNO085 ready\r\n"
    options = TableDeviceOptions(fields, rate_hz, greeting=greeting)
    keys = [
        f'port = "{port}"',
        "baud = 921600",
        'text = { prefix = "$Q,", columns = 6, checksum = { kind = "xor8", first = 1 } }',
        'fields.time = { column = 1, unit = "us" }',
        "fields.counter = { column = 2 }",
        'fields.quaternion = { column = 3, order = "xyzw" }',
    ]
    return TableDevice(SerialTablePort(port, wire, noise), options), keys


def time_and_integers(bus: CanWire, first_id: int, rate_hz: float) -> tuple[TableDevice, list[str]]:
    """Return a device with the CAN frames of an SBG Ellipse, and its keys in rig.toml."""
    fields = {slot: TableField(2 * slot, "i", 16, scale=1 / _COUNTS, frame=1) for slot in range(4)}
    fields[_TIME] = TableField(0, "u", 32, scale=S_PER_US)
    table = CanTable(((first_id, False), (first_id + 1, False)), fields)
    options = TableDeviceOptions(fields, rate_hz, world="NED")
    keys = [
        f"ids = {{ time = {first_id:#05x}, quaternion = {first_id + 1:#05x} }}",
        'world = "NED"',
        'fields.time = { offset = 0, type = "u32", unit = "us" }',
        f'fields.quaternion = {{ offset = 0, type = "i16", divisor = {_COUNTS} }}',
    ]
    return TableDevice(CanTablePort(bus, table), options), keys


def halves_of_floats(bus: CanWire, first_id: int, rate_hz: float) -> tuple[TableDevice, list[str]]:
    """Return a device that sends two floats per frame and no time, and its keys in rig.toml."""
    fields = {slot: TableField(4 * (slot % 2), "f", 32, frame=slot // 2) for slot in range(4)}
    table = CanTable(((first_id, False), (first_id + 1, False)), fields)
    options = TableDeviceOptions(fields, rate_hz, world="NWU", world_to_sensor=True)
    part = '{{ frame = "{}", offset = 0, type = "f32", order = "{}" }}'
    keys = [
        f"ids = {{ first = {first_id:#05x}, second = {first_id + 1:#05x} }}",
        'world = "NWU"',
        'direction = "world_to_sensor"',
        f"fields.quaternion = [{part.format('first', 'wx')}, {part.format('second', 'yz')}]",
    ]
    return TableDevice(CanTablePort(bus, table), options), keys
