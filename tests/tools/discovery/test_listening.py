"""Reception on a port or a CAN interface finds the drivers that decode the received data."""

from __future__ import annotations

import asyncio
import os
import socket
import struct
import termios
import time
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.files.captures import pack_can_frame
from jointfit_daemon.model import Chunk
from jointfit_daemon.tools.discovery import _can_listening as can_listening
from jointfit_daemon.tools.discovery import (
    decode_traffic,
    listen_can,
    listen_serial,
    usual_bauds,
)
from jointfit_drivers.xbus import XbusImu
from jointfit_drivers.xcdi import XcdiImu
from jointfit_protocols.can import pack_frames
from jointfit_protocols.xbus import encode
from jointfit_protocols.xcdi import id_block
from jointfit_simulators.devices import (
    XbusDevice,
    XbusDeviceOptions,
    XcdiDevice,
    XcdiDeviceOptions,
)

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

    from jointfit_protocols.can import CanFrame

pytestmark = pytest.mark.real_time

Q = (1.0, 0.0, 0.0, 0.0)
PERIOD_NS = 10_000_000
LISTEN_S = 0.4


@pytest.fixture
async def streaming(tmp_path: Path) -> AsyncIterator[str]:
    """Yield the port of an IMU that sends 100 samples per second."""
    device = XbusDevice(tmp_path / "imu", options=XbusDeviceOptions(measures_at_once=True))

    async def push() -> None:
        while True:
            device.push(time.monotonic_ns(), Q)
            await asyncio.sleep(PERIOD_NS / 1e9)

    tasks = [asyncio.create_task(device.run()), asyncio.create_task(push())]
    yield str(tmp_path / "imu")
    for task in tasks:
        task.cancel()
    await asyncio.wait(tasks)
    device.unplug()


async def test_a_streaming_imu_is_recognized_with_speed_and_rate(streaming: str) -> None:
    found = await asyncio.to_thread(listen_serial, streaming, listen_s=LISTEN_S)
    assert found.fault is None
    assert found.baud == usual_bauds()[0] == 115_200
    (device,) = found.devices
    assert device.driver == "xbus"
    assert device.samples > 10
    assert device.rate_hz == pytest.approx(100, rel=0.3)
    assert device.settings == {"baud": 115_200}


async def test_listening_restores_the_settings_of_the_port(tmp_path: Path) -> None:
    controller, line = os.openpty()
    path = os.ttyname(line)
    before = termios.tcgetattr(line)
    os.write(controller, b"text of another device\n" * 20)
    found = await asyncio.to_thread(listen_serial, path, listen_s=0.05, bauds=[9600, 230_400])
    assert found.devices == ()
    assert termios.tcgetattr(line) == before
    for descriptor in (controller, line):
        os.close(descriptor)


def test_a_silent_port_is_not_tried_at_other_speeds() -> None:
    controller, line = os.openpty()
    shares: list[float] = []
    found = listen_serial(os.ttyname(line), listen_s=0.05, progress=shares.append)
    assert (found.received_bytes, found.devices) == ({115_200: 0}, ())
    assert shares == [1 / len(usual_bauds())]
    for descriptor in (controller, line):
        os.close(descriptor)


@pytest.mark.parametrize(
    ("name", "text"), [("gone", "is absent"), ("file", "is not a serial port")]
)
def test_a_path_that_is_no_port_is_a_fault_with_a_remedy(
    tmp_path: Path, name: str, text: str
) -> None:
    (tmp_path / "file").write_text("")
    found = listen_serial(str(tmp_path / name))
    assert found.fault is not None
    assert text in found.fault
    assert "jointfit probe" in found.fault


def test_noise_with_an_accidental_message_is_no_device() -> None:
    noise = bytes(range(256)) * 4
    for wire in (noise, noise + encode(0x36, b"") + noise, b""):
        assert decode_traffic(XbusImu, "xbus", {"baud": 115_200}, [Chunk(0, wire)]) is None


def test_a_device_without_orientations_is_recognized_by_its_messages() -> None:
    # Messages MTData2 that contain only a packet counter.
    wire = encode(0x36, bytes([0x10, 0x20, 2, 0, 1])) * 20
    found = decode_traffic(XbusImu, "xbus", {"baud": 115_200}, [Chunk(0, wire)])
    assert found is not None
    assert (found.messages, found.samples, found.rate_hz) == (20, 0, None)


class _Bus:
    """CAN bus that collects the frames of simulated sensors."""

    bitrate = None
    is_open = True

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []

    def send(self, frames: Any) -> bool:
        self.frames += frames
        return True


def sensor_frames(base: int, count: int = 40) -> list[CanFrame]:
    bus = _Bus()
    device = XcdiDevice(bus, XcdiDeviceOptions(ids=id_block(base)))  # type: ignore[arg-type]
    for number in range(count):
        device.push(number * PERIOD_NS, Q)
    step = PERIOD_NS * count // len(bus.frames)
    return [frame._replace(t_ns=k * step) for k, frame in enumerate(bus.frames)]


def test_sensors_on_one_bus_are_separated_by_their_identifiers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames = sorted(sensor_frames(0) + sensor_frames(0x100), key=lambda frame: frame.t_ns)
    received = [(frame.t_ns, frame.can_id, frame.data) for frame in frames]
    received.append((1, 0x123 | 1 << 31, b"foreign"))
    received.append((2, 1 << 29 | 4, bytes(8)))  # an error frame of the controller
    monkeypatch.setattr(can_listening, "_receive", lambda *_: received)

    found = listen_can("can0")
    assert found.error_frames == 1
    assert [device.driver for device in found.devices] == ["xcdi", "xcdi"]
    quaternions = [device.settings["ids"]["quaternion"] for device in found.devices]
    assert quaternions == [0x21, 0x121]
    for device in found.devices:
        assert device.usual_rate_hz == 100
        assert "byte_order" not in device.settings
    (foreign,) = [each for each in found.identifiers if each.extended]
    assert (foreign.id, foreign.driver, foreign.data_bytes) == (0x123, None, 7)
    (owned,) = [each for each in found.identifiers if each.id == 0x21]
    assert (owned.driver, owned.frames) == ("xcdi", 40)
    assert owned.rate_hz == pytest.approx(100, rel=0.1)


def test_the_records_of_received_frames_are_those_of_the_drivers() -> None:
    for frame in sensor_frames(0)[:4]:
        own = pack_can_frame(frame.t_ns, frame.can_id, frame.data, extended=frame.extended)
        assert own == pack_frames([frame])
        long = frame._replace(extended=True)
        assert pack_can_frame(long.t_ns, long.can_id, long.data, extended=True) == pack_frames(
            [long]
        )


def test_a_driver_proposes_only_identifiers_in_ascending_order() -> None:
    seen = {(0x21, False): 8, (0x22, False): 2, (0x23, False): 4}
    assert list(XcdiImu.candidate_tables(seen)) == []


def test_an_interface_that_does_not_exist_is_a_fault() -> None:
    try:
        socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW).close()
        expected = "no such CAN interface"
    except OSError:
        expected = "no CAN in this kernel"
    found = listen_can("nocan9", listen_s=0.1)
    assert found.fault is not None
    assert expected in found.fault


def test_the_frame_of_the_kernel_has_its_size() -> None:
    assert struct.calcsize("=IB3x8s") == can_listening._FRAME.size == 16
