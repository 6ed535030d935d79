"""Conformance tests of the VRPN driver, in every form of connection."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from typing_extensions import override

from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import VrpnServer, VrpnServerOptions
from tests.drivers.motion_capture.mocap_contract import MocapContract

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.model import MocapFrame


pytestmark = pytest.mark.real_time


BODY = {"rigid_body": {"thigh": "Thigh"}}


class TestVrpn(MocapContract):
    registered_as = "vrpn"
    baud = None
    options = VrpnServerOptions(bodies=("Thigh",))
    port_key = "port"
    keys: ClassVar[dict[str, Any]] = BODY

    @override
    def make_server(self) -> VrpnServer:
        return VrpnServer(self.options)

    @override
    def send(self, device: VrpnServer, number: int) -> None:
        pose = ((0.1, 0.2, 0.001 * number), orientation(number))
        device.push(0, {}, {"Thigh": pose})

    @override
    def matches(self, number: int, measurement: MocapFrame) -> bool:
        q = measurement.body_orientations[0]
        same = abs(sum(a * b for a, b in zip(q, orientation(number), strict=True))) > 1 - 1e-9
        return bool(same and abs(measurement.body_positions[0, 2] - 0.001 * number) < 1e-9)


class TestVrpnUdp(TestVrpn):
    keys: ClassVar[dict[str, Any]] = BODY | {"transport": "udp"}


class TestVrpnClassic(TestVrpn):
    keys: ClassVar[dict[str, Any]] = BODY | {"connection": "classic"}
    options = VrpnServerOptions(bodies=("Thigh",), connections=frozenset({"classic"}))

    @override
    def make_wrong_device(self, folder: Path) -> None:
        return None  # a program that does not know the announcement does not connect back


class TestVrpnClassicUdp(TestVrpnClassic):
    keys: ClassVar[dict[str, Any]] = BODY | {
        "connection": "classic",
        "transport": "udp",
        "unit": "mm",
    }
    options = VrpnServerOptions(bodies=("Thigh",), unit="mm", segment_bytes=7)
