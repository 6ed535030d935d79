"""Independent clients read what the simulated QTM server writes."""

from __future__ import annotations

import asyncio
import struct
from typing import Any

import pytest
import qtm_rt

from tests.drivers.motion_capture.oracle_client import needs_client, oracle_frames
from tests.drivers.qtm.serving import POSE, SEEN, made, served

pytestmark = pytest.mark.real_time


def single(value: float) -> float:
    """Return the nearest float of 32 bits."""
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


async def vendor_frames(port: int, components: list[str], count: int) -> tuple[str, list[Any]]:
    connection = await qtm_rt.connect("127.0.0.1", port=port, version="1.25", timeout=10)
    assert connection is not None
    parameters = await connection.get_parameters(parameters=["3d", "6d"])
    packets: list[Any] = []
    done = asyncio.Event()

    def take(packet: Any) -> None:
        packets.append(packet)
        if len(packets) >= count:
            done.set()

    await connection.stream_frames(components=components, on_packet=take)
    async with asyncio.timeout(10):
        await done.wait()
    connection.disconnect()
    return parameters.decode(), packets


async def test_the_client_of_the_vendor_reads_every_number_to_the_last_bit() -> None:
    server = made(up_axis="z")
    names = ["6dres", "3dres", "3dnolabels", "timecode"]
    async with served(server):
        xml, packets = await vendor_frames(server.command_port, names, 3)
    assert "<Name>Thigh</Name>" in xml
    assert "<AxisUpwards>+Z</AxisUpwards>" in xml

    first, second = packets[0], packets[1]
    assert second.framenumber == first.framenumber + 1
    assert second.timestamp > first.timestamp
    _, markers = first.get_3d_markers_residual()
    assert len(markers) == 4
    for marker, name in zip(markers, ("T1", "T2", "T3", "S1"), strict=True):
        if name in SEEN:
            expected = tuple(single(1000 * value) for value in SEEN[name])
            assert (marker.x, marker.y, marker.z) == expected
        else:
            assert marker.x != marker.x
    _, loose = first.get_3d_markers_no_label()
    assert [(marker.x, marker.id) for marker in loose] == [(9000.0, 3)]

    _, bodies = first.get_6d_residual()
    (position, rotation, _), (missing, _, _) = bodies
    assert (position.x, position.y, position.z) == tuple(1000 * v for v in POSE[0])
    # Column-major: cos, sin, 0 is the first column of a turn about z.
    columns = [single(v) for v in (0.28, 0.96, 0, -0.96, 0.28, 0, 0, 0, 1)]
    assert list(rotation.matrix) == pytest.approx(columns, abs=1e-7)
    assert missing.x != missing.x


async def test_the_client_of_the_vendor_is_refused_when_there_are_too_many() -> None:
    server = made(most_clients=0)
    async with served(server):
        connection = await qtm_rt.connect("127.0.0.1", port=server.command_port, timeout=1)
    assert connection is None


@needs_client
@pytest.mark.xdist_group("udp-6734")
async def test_a_client_in_c_plus_plus_reads_the_bodies() -> None:
    server = made(up_axis="z")
    settings = {"hostname": "127.0.0.1", "port": str(server.command_port - 1)}
    async with served(server), oracle_frames("qualisys", **settings) as next_frame:
        bodies = await next_frame()
        while not bodies:
            bodies = await next_frame()
    assert list(bodies) == ["Thigh"]
    *position, w, x, y, z = bodies["Thigh"]
    assert position == pytest.approx(POSE[0], abs=1e-5)
    same = abs(sum(a * b for a, b in zip((w, x, y, z), POSE[1], strict=True)))
    assert same == pytest.approx(1, abs=1e-5)
