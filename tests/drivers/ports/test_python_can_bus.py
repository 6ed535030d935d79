"""Buses of python-can: reader threads, errors reported once, and error messages."""

from __future__ import annotations

import asyncio
import socket
import time
from typing import TYPE_CHECKING, Any

import can
import pytest
from pydantic import ValidationError
from typing_extensions import override

from jointfit_daemon.driver import CanBusSettings, DeviceLostError, DeviceMisconfiguredError
from jointfit_drivers.ports.can_bus import shared_bus
from jointfit_protocols.can import CanFrame, unpack_frames
from jointfit_protocols.xcdi import id_block
from jointfit_simulators.devices import XcdiDevice, XcdiDeviceOptions
from jointfit_simulators.wires import PythonCanWire
from tests.drivers.driver_run import IDENTITY, DriverRun, xcdi_driver

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk


async def test_a_bus_of_python_can_is_shared_too() -> None:
    bus = CanBusSettings(interface="virtual", channel="shared")
    wire = PythonCanWire("virtual", "shared")
    devices = [XcdiDevice(wire, XcdiDeviceOptions(ids=id_block(base))) for base in (0x100, 0x200)]
    try:
        runs = [DriverRun(xcdi_driver("S3", bus, 0x100)), DriverRun(xcdi_driver("S4", bus, 0x200))]
        async with shared_bus(bus) as opened_bus:
            await asyncio.sleep(0.05)
            began = time.monotonic_ns()
            for number in range(100):
                for device in devices:
                    device.push(number * 10_000_000, IDENTITY)
            for run in runs:
                await run.wait_for(100)
                assert began <= run.samples[0].arrival_ns <= time.monotonic_ns()
            assert opened_bus.foreign == 0, "python-can filters for us"
        for run in runs:
            await run.cancel()
    finally:
        wire.unplug()


class Broken(can.BusABC):
    """Replacement for the library of a vendor. Its reads fail with the given error."""

    def __init__(self, error: Exception) -> None:
        super().__init__(channel="x")
        self._error = error

    @override
    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        time.sleep(0.01)
        raise self._error

    @override
    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError


@pytest.mark.parametrize(
    ("error", "kind"),
    [
        (can.CanOperationError("adapter pulled out", 19), DeviceLostError),
        (can.CanOperationError("something of the vendor's"), DeviceLostError),
        (ValueError("the backend cannot parse a line"), DeviceLostError),
        (ZeroDivisionError(), ZeroDivisionError),
    ],
)
async def test_error_of_the_receive_thread_is_raised_in_the_driver(
    monkeypatch: pytest.MonkeyPatch, error: Exception, kind: type[Exception]
) -> None:
    monkeypatch.setattr(can, "Bus", lambda **_: Broken(error))
    bus = CanBusSettings(interface="virtual", channel="broken")
    with pytest.raises(kind):
        await xcdi_driver("S3", bus).run(lambda _: None)


async def test_unknown_interfaces_are_named_with_the_nearest() -> None:
    bus = CanBusSettings(interface="socketcna", channel="can0")
    with pytest.raises(ValidationError, match="did you mean 'socketcan'"):
        xcdi_driver("S3", bus)
    with pytest.raises(DeviceMisconfiguredError, match="did you mean 'socketcan'"):
        async with shared_bus(bus):
            pass


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"interface": "vector"}, "exists on Windows only: set interface"),
        ({"interface": "etas"}, "exists on Windows only"),
        ({"interface": "kvaser"}, r"libcanlib.so.*install its library"),
        ({"interface": "pcan"}, r"libpcanbasic.so.*install its library"),
        ({"interface": "neovi"}, "package 'ics' is not installed"),
        ({"interface": "socketcand"}, "host: missing: .* port: missing: "),
        ({"interface": "socketcand", "host": "::1", "port": 99999}, "port = 1 to 65535"),
        ({"interface": "socketcand", "host": "::1", "port": "abc"}, "found 'abc'"),
        ({"interface": "udp_multicast", "channel": "239.1.1.1", "hop_limit": 300}, "0 to 255"),
        ({"interface": "seeedstudio", "channel": "/dev/a", "bitrate": 300_000}, "bitrate: expect"),
        ({"interface": "serial", "channel": "/dev/a", "baud": 9600}, "set baudrate instead"),
        (
            {"interface": "udp_multicast", "channel": "can0"},
            "channel: expected a multicast add",
        ),
    ],
)
async def test_a_bus_that_cannot_exist_here_has_one_text_in_check_and_daemon(
    table: dict[str, Any], words: str
) -> None:
    """`jointfit check` and the daemon report the same text."""
    bus = CanBusSettings(**{"channel": "0"} | table)
    with pytest.raises(ValidationError, match=words):
        xcdi_driver("S3", bus)
    with pytest.raises(DeviceMisconfiguredError, match=words):
        async with shared_bus(bus):
            pass


def test_a_complete_network_bus_is_accepted() -> None:
    more: dict[str, Any] = {"host": "192.168.1.5", "port": 29536}
    xcdi_driver("S3", CanBusSettings(interface="socketcand", channel="can0", **more))
    xcdi_driver("S3", CanBusSettings(interface="udp_multicast", channel="239.74.163.2"))


async def test_an_absent_port_of_an_adapter_is_named_once() -> None:
    with pytest.raises(DeviceLostError) as lost:
        async with shared_bus(CanBusSettings(interface="robotell", channel="/dev/nowhere")):
            pass
    assert str(lost.value) == (
        "/dev/nowhere (robotell): No such file or directory: plug it in, or correct `channel`"
    )


@pytest.mark.parametrize(
    ("number", "kind", "words"),
    [
        (97, DeviceMisconfiguredError, "no CAN in this kernel.*can_raw"),
        (19, DeviceLostError, "no such CAN interface"),
    ],
)
async def test_kernels_without_can_and_absent_links(
    monkeypatch: pytest.MonkeyPatch, number: int, kind: type[Exception], words: str
) -> None:
    """An absent interface may appear later. A kernel without CAN is a wrong setup."""

    def refuse(_: str) -> None:
        raise OSError(number, "as the kernel says it")

    monkeypatch.setattr("jointfit_drivers.ports._python_can_bus._require_interface", refuse)
    with pytest.raises(kind, match=words):
        await xcdi_driver("S3", CanBusSettings(channel="can0")).run(lambda _: None)


class Filtered(can.BusABC):
    """Replacement for SocketCAN with a descriptor, stamps, and an error when the link is down."""

    def __init__(self, **_: Any) -> None:
        self.socket, self.far = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.socket.setblocking(False)
        self.down = False
        super().__init__(channel="can0")

    @override
    def fileno(self) -> int:
        return self.socket.fileno()

    @override
    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        try:
            data = self.socket.recv(16)
        except BlockingIOError:
            return None, True
        if data == b"down":
            raise can.CanOperationError("Network is down", 100)
        return can.Message(
            arbitration_id=0x21,
            is_extended_id=False,
            data=data,
            timestamp=time.time(),
        ), True

    @override
    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        raise NotImplementedError

    @override
    def shutdown(self) -> None:
        super().shutdown()
        self.socket.close()
        self.far.close()


async def test_link_down_is_reported_once_after_the_frames_before_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[Filtered] = []

    def make(**words: Any) -> Filtered:
        made.append(Filtered(**words))
        return made[-1]

    monkeypatch.setattr(can, "Bus", make)
    monkeypatch.setattr("jointfit_drivers.ports._python_can_bus._require_interface", lambda _: None)
    chunks: list[Chunk] = []
    driver = xcdi_driver("S3", CanBusSettings(channel="can0"))
    task = asyncio.create_task(driver.run(chunks.append))
    await asyncio.sleep(0.02)
    for number in range(100):
        made[0].far.send(bytes([number] * 8))
    made[0].far.send(b"down")
    with pytest.raises(DeviceLostError, match="ip link set can0 up"):
        await task
    found = [frame for chunk in chunks for frame in unpack_frames(chunk.data)]
    assert [frame.data[0] for frame in found if isinstance(frame, CanFrame)] == list(range(100))
    assert max(len(chunk.data) for chunk in chunks) <= 64 * 24
