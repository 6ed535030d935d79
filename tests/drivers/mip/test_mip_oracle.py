"""The vendor's library reads the values that the virtual MIP device has encoded."""

from __future__ import annotations

import math
import os
import struct
import threading
import time
import tty
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_protocols.mip import MipCodec, MipPacket
from jointfit_protocols.mip.data import decode_field
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import MipDevice, MipDeviceOptions

if TYPE_CHECKING:
    from pathlib import Path

mscl: Any = pytest.importorskip("mscl", reason="pymscl has wheels for x86-64 only")
COUNT = 10
FORMATS = (
    (0x80, ((0xD5, 1), (0x04, 1), (0x05, 1), (0x06, 1), (0x0A, 1))),
    (0x82, ((0xD5, 1), (0x03, 1))),
)


class Recorder:
    """Wire that stores the packets of a device and withholds them from its line."""

    def __init__(self) -> None:
        self.packets: list[bytes] = []

    def __call__(self, wire: bytes) -> bytes:
        self.packets.append(wire)
        return b""


def read_by_vendor(packets: list[bytes]) -> list[dict[str, Any]]:
    """Return the channels of each packet as the vendor's library reads them from a pty."""
    near, far = os.openpty()
    tty.setraw(far)
    connection = mscl.Connection.Serial(os.ttyname(far), 115_200)
    node = mscl.InertialNode(connection)
    found: list[dict[str, Any]] = []

    def write() -> None:  # the library loses data that arrives fast
        for packet in packets:
            os.write(near, packet)
            time.sleep(0.002)

    writer = threading.Thread(target=write)
    writer.start()
    try:
        until = time.monotonic() + 10
        while len(found) < len(packets) and time.monotonic() < until:
            for packet in node.getDataPackets(100, 0):
                points = {point.channelName(): point for point in packet.data()}
                found.append({"set": packet.descriptorSet(), **points})
    finally:
        writer.join()
        connection.disconnect()
        os.close(near)
        os.close(far)
    return found


def test_the_vendors_library_reads_every_value_of_both_data_sets(tmp_path: Path) -> None:
    recorder = Recorder()
    options = MipDeviceOptions(formats=FORMATS, streams=(0x80, 0x82), filter_delay=0)
    device = MipDevice(tmp_path / "imu", options=options, wire_noise=recorder)
    for number in range(COUNT):
        device.push(1_000_000_000 + number * 10_000_000, orientation(number))
    device.unplug()
    codec = MipCodec()
    ours = [one for data in recorder.packets for one in codec.feed(data)]

    theirs = read_by_vendor(recorder.packets)
    assert len(theirs) == len(ours) == 2 * COUNT
    for packet, read in zip(ours, theirs, strict=True):
        assert isinstance(packet, MipPacket)
        assert packet.descriptor_set == read["set"]
        values = {one: decode_field(read["set"], one, data) or () for one, data in packet.fields}
        name = "estOrientQuaternion" if read["set"] == 0x82 else "orientQuaternion"
        quaternion = read[name].as_Vector()
        same = [quaternion.as_floatAt(k) for k in range(4)]
        assert same == list(values[0x03 if read["set"] == 0x82 else 0x0A][:4])
        if read["set"] == 0x80:
            check_sensor(values, read)


def check_sensor(values: dict[int, tuple[Any, ...]], read: dict[str, Any]) -> None:
    names = {0x04: "scaledAccel", 0x05: "scaledGyro", 0x06: "scaledMag"}
    for field, name in names.items():
        same = tuple(read[f"{name}{axis}"].as_float() for axis in "XYZ")
        assert same == values[field]
        assert all(map(math.isfinite, same))
    assert struct.pack(">3f", *values[0x04])
