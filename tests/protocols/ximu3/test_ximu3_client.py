"""The vendor's client and the codec read equal values, to the last bit, from the same bytes."""

from __future__ import annotations

import math
import random
import struct
import time
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.ximu3 import DataKind, XImu3Codec, XImu3Data, encode_data, encode_text
from jointfit_simulators.devices import XImu3Device, XImu3DeviceOptions

if TYPE_CHECKING:
    from pathlib import Path

ximu3 = pytest.importorskip("ximu3", reason="the vendor's client is not installed")

FIELDS = {
    "quaternion": ("Q", "w x y z"),
    "rotation_matrix": ("R", "xx xy xz yx yy yz zx zy zz"),
    "euler_angles": ("A", "roll pitch yaw"),
    "linear_acceleration": ("L", "x y z"),
    "earth_acceleration": ("E", "x y z"),
    "inertial": (
        "I",
        "gyroscope_x gyroscope_y gyroscope_z accelerometer_x accelerometer_y accelerometer_z",
    ),
    "magnetometer": ("M", "x y z"),
    "high_g_accelerometer": ("H", "x y z"),
    "sync": ("Y", "edge"),
    "temperature": ("T", "temperature"),
    "battery": ("B", "percentage voltage charging_status"),
    "rssi": ("W", "percentage power"),
    "button": ("O", "state"),
}
TEXTS = {
    "ahrs_status": "U", "notification": "N", "error": "F", "serial_accessory": "S", "ltc": "C",
}  # fmt: skip


def read_by_vendor(wire: bytes, file: Path) -> tuple[list[tuple[Any, ...]], list[str]]:
    """Return kind, time and values of all messages in the vendor's client, and its errors."""
    file.write_bytes(wire)
    found: list[tuple[Any, ...]] = []
    errors: list[str] = []
    connection = ximu3.Connection(ximu3.FileConnectionConfig(str(file)))
    connection.add_receive_error_callback(lambda error: errors.append(str(error)))
    for name, (kind, fields) in FIELDS.items():

        def add(message: Any, kind: str = kind, fields: str = fields) -> None:
            values = tuple(getattr(message, field) for field in fields.split())
            found.append((kind, message.timestamp, values))

        getattr(connection, f"add_{name}_callback")(add)
    for name, kind in TEXTS.items():

        def add_text(message: Any, kind: str = kind) -> None:
            found.append((kind, message.timestamp, bytes(message.bytes)))

        getattr(connection, f"add_{name}_callback")(add_text)

    # The client reads the file in a separate thread, and does not report the end of the file.
    expected = wire.count(b"\n")
    connection.open()
    until = time.monotonic() + 20
    while len(found) + len(errors) < expected and time.monotonic() < until:
        time.sleep(0.01)
    connection.close()
    return found, errors


def read_here(wire: bytes) -> list[tuple[Any, ...]]:
    return [
        (str(event.kind), event.ticks, event.values or event.text)
        for event in XImu3Codec().feed(wire)
        if isinstance(event, XImu3Data)
    ]


def test_the_vendors_client_reads_every_kind_of_message(tmp_path: Path) -> None:
    dice = random.Random(5)
    wire = b""
    for _ in range(20):
        for kind, fields in FIELDS.values():
            bits = dice.randbytes(4 * len(fields.split()))
            values = struct.unpack(f"<{len(bits) // 4}f", bits)
            if all(map(math.isfinite, values)):
                wire += encode_data(kind, dice.randrange(2**63), values)
        for kind in TEXTS.values():
            wire += encode_text(kind, dice.randrange(2**63), dice.randbytes(dice.randrange(1, 50)))
    found, errors = read_by_vendor(wire, tmp_path / "all.ximu3")
    assert errors == []
    assert found == read_here(wire)


@pytest.mark.parametrize("binary", [True, False])
def test_the_vendors_client_reads_the_simulated_device(tmp_path: Path, binary: bool) -> None:
    sent: list[bytes] = []

    def record(data: bytes) -> bytes:
        sent.append(data)
        return data

    stored = {"serial_mode": 2, "binary_mode_enabled": binary}
    options = XImu3DeviceOptions(stored, interface="USB", error="fault")
    device = XImu3Device(tmp_path / "imu", options=options, wire_noise=record)
    for number in range(100):
        angle = 0.01 * number
        device.push(number * 20_000_000, (math.cos(angle), math.sin(angle), 0.0, 0.0))
    device.edge(1_990_000_000)
    device.unplug()

    found, errors = read_by_vendor(b"".join(sent), tmp_path / "device.ximu3")
    here = read_here(b"".join(sent))
    assert errors == []
    assert {kind for kind, _, _ in here} == {"Q", "I", "M", "B", "F", "Y"}
    assert [entry[:2] for entry in found] == [entry[:2] for entry in here]
    if binary:
        assert found == here


def test_both_count_the_same_messages_in_the_recording(tmp_path: Path, shared_data: Path) -> None:
    wire = (shared_data / "imu" / "ximu3" / "synthetic_quaternion.ximu3").read_bytes()
    found, errors = read_by_vendor(wire, tmp_path / "copy.ximu3")
    assert errors == []
    assert len(found) == 203
    # The first message is ASCII, and the client rounds its numbers to float32.
    assert found[1:] == read_here(wire)[1:]


def test_both_refuse_the_same_malformed_lines(tmp_path: Path) -> None:
    good = encode_data(DataKind.QUATERNION, 5, (1.0, 0.0, 0.0, 0.0))
    lines = (
        b"\xd1\x00\n", b"\xd1" + 16 * b"\xdb\xdb" + b"\n", b"hello\r\n", b"Q,1,2,3\r\n", b"\n",
    )  # fmt: skip
    wire = b"".join(good + line for line in lines) + good
    found, errors = read_by_vendor(wire, tmp_path / "bad.ximu3")
    here = [event for event in XImu3Codec().feed(wire) if isinstance(event, CorruptBytes)]
    assert len(errors) == len(here) == len(lines)
    assert found == read_here(wire)
