"""The NatNet driver against the conformance suite of drivers."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from typing_extensions import override

from jointfit_daemon.model import MocapFrame
from jointfit_drivers.natnet import NatNetMocap, NatNetSettings
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import NatNetServer, NatNetServerOptions, RigidBodyAsset
from jointfit_simulators.devices._natnet_port import NatNetPort
from jointfit_simulators.driver_contract import DriverContract

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time

THIGH = RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1)


class Gossip:
    """Answers every datagram, in a language that is not NatNet."""

    def __init__(self) -> None:
        self._port = NatNetPort()
        self.command_port = self._port.command_port
        self.unplug, self.plug = self._port.unplug, self._port.plug

    async def run(self) -> None:
        await self._port.serve(self._answer)

    def _answer(self, _: bytes, address: tuple[str, int]) -> None:
        self._port.send(b"HTTP/1.1 400 what\r\n", address)


class TestNatNet(DriverContract):
    registered_as = "natnet"
    measurement = MocapFrame
    has_noise = False  # a UDP checksum tells damaged datagrams apart before we see them
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
    options = NatNetServerOptions(bodies=(THIGH,), bitstream=(3, 1))
    keys: ClassVar[dict[str, Any]] = {}
    _devices: list[Any]

    @pytest.fixture(autouse=True)
    def _close(self) -> Iterator[None]:
        self._devices = []
        yield
        for device in self._devices:
            device.unplug()

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> NatNetServer:
        device = NatNetServer(self.options)
        self._devices.append(device)
        return device

    @override
    def make_driver(self, folder: Path) -> Driver:
        port = self._devices[-1].command_port if self._devices else 1510
        settings = NatNetSettings(
            driver="natnet", server="127.0.0.1", command_port=port, silence_s=0.5,
            markers={"thigh": THIGH.markers}, **self.keys,
        )  # fmt: skip
        return NatNetMocap(settings)

    @override
    def make_wrong_device(self, folder: Path) -> Gossip:
        device = Gossip()
        self._devices.append(device)
        return device

    @override
    def send(self, device: NatNetServer, number: int) -> None:
        pose = ((0.1, 0.2, 0.001 * number), orientation(number))
        device.push(
            self.device_ns(device, number), {"T1": (1.0, 2.0, 0.001 * number)}, {"Thigh": pose}
        )

    @override
    def matches(self, number: int, measurement: MocapFrame) -> bool:
        q = measurement.body_orientations[0]
        same = abs(sum(a * b for a, b in zip(q, orientation(number), strict=True))) > 1 - 1e-6
        return bool(same and abs(measurement.markers[0, 2] - 0.001 * number) < 1e-6)


class TestNatNet41(TestNatNet):
    options = NatNetServerOptions(bodies=(THIGH,), bitstream=(4, 1))


class TestNatNet29(TestNatNet):
    options = NatNetServerOptions(bodies=(THIGH,), bitstream=(2, 9))
    keys: ClassVar[dict[str, Any]] = {"transport": "unicast"}


class TestNatNet25(TestNatNet29):
    options = NatNetServerOptions(bodies=(THIGH,), bitstream=(2, 5))


def multicast_works() -> bool:
    """Whether loopback carries multicast on this machine."""
    lo, group = socket.inet_aton("127.0.0.1"), "239.255.42.99"
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as heard,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as said,
    ):
        heard.settimeout(0.5)
        heard.bind(("", 0))
        try:
            join = socket.inet_aton(group) + lo
            heard.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, join)
            said.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, lo)
            said.sendto(b"?", (group, heard.getsockname()[1]))
            return heard.recv(9) == b"?"
        except OSError:
            return False


@pytest.mark.skipif(not multicast_works(), reason="loopback carries no multicast here")
class TestNatNetMulticast(TestNatNet):
    options = NatNetServerOptions(bodies=(THIGH,), transport="multicast")
