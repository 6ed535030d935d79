"""Conformance tests of the NatNet driver."""

from __future__ import annotations

import socket
from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from typing_extensions import override

from jointfit_simulators.devices import NatNetServer, NatNetServerOptions
from jointfit_simulators.devices._natnet_port import NatNetPort
from tests.drivers.motion_capture.mocap_contract import THIGH, MocapContract

if TYPE_CHECKING:
    from pathlib import Path


pytestmark = pytest.mark.real_time


class ForeignUdpServer:
    """Answers every datagram with a message that is not NatNet."""

    def __init__(self) -> None:
        self._port = NatNetPort()
        self.command_port = self._port.command_port
        self.unplug, self.plug = self._port.unplug, self._port.plug

    async def run(self) -> None:
        await self._port.serve(self._answer)

    def _answer(self, _: bytes, address: tuple[str, int]) -> None:
        self._port.send(b"HTTP/1.1 400 what\r\n", address)


class TestNatNet(MocapContract):
    registered_as = "natnet"
    options = NatNetServerOptions(bodies=(THIGH,), bitstream=(3, 1))

    @override
    def make_server(self) -> NatNetServer:
        return NatNetServer(self.options)

    @override
    def make_wrong_device(self, folder: Path) -> ForeignUdpServer:
        return self.opened(ForeignUdpServer())


class TestNatNet41(TestNatNet):
    options = NatNetServerOptions(bodies=(THIGH,), bitstream=(4, 1))


class TestNatNet29(TestNatNet):
    options = NatNetServerOptions(bodies=(THIGH,), bitstream=(2, 9))
    keys: ClassVar[dict[str, Any]] = MocapContract.keys | {"transport": "unicast"}


class TestNatNet25(TestNatNet29):
    options = NatNetServerOptions(bodies=(THIGH,), bitstream=(2, 5))


def multicast_works() -> bool:
    """Return whether the loopback interface of this machine transports multicast."""
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
