"""The VRPN driver against the conformance suite of drivers, in every form of connection."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from typing_extensions import override

from jointfit_daemon.model import MocapFrame
from jointfit_drivers.vrpn import VrpnMocap, VrpnSettings
from jointfit_protocols.vrpn import DEFAULT_PORT
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import TextServer, VrpnServer, VrpnServerOptions
from jointfit_simulators.driver_contract import DriverContract

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time


class TestVrpn(DriverContract):
    registered_as = "vrpn"
    measurement = MocapFrame
    has_noise, baud = False, None  # TCP and UDP have checksums
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
    options = VrpnServerOptions(bodies=("Thigh",))
    keys: ClassVar[dict[str, str]] = {}
    _devices: list[Any]

    @pytest.fixture(autouse=True)
    def _close(self) -> Iterator[None]:
        self._devices = []
        yield
        for device in self._devices:
            device.unplug()

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> VrpnServer:
        device = VrpnServer(self.options)
        self._devices.append(device)
        return device

    @override
    def make_driver(self, folder: Path) -> Driver:
        port = self._devices[-1].command_port if self._devices else DEFAULT_PORT
        table = {"driver": "vrpn", "server": "127.0.0.1", "port": port, "silence_s": 0.5}
        body = {"rigid_body": {"thigh": "Thigh"}}
        return VrpnMocap(VrpnSettings.model_validate(table | body | self.keys))

    @override
    def make_wrong_device(self, folder: Path) -> TextServer | None:
        device = TextServer(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        self._devices.append(device)
        return device

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
    keys: ClassVar[dict[str, str]] = {"transport": "udp"}


class TestVrpnClassic(TestVrpn):
    keys: ClassVar[dict[str, str]] = {"connection": "classic"}
    options = VrpnServerOptions(bodies=("Thigh",), connections=frozenset({"classic"}))

    @override
    def make_wrong_device(self, folder: Path) -> None:
        return None  # a program that does not know the announcement does not connect back


class TestVrpnClassicUdp(TestVrpnClassic):
    keys: ClassVar[dict[str, str]] = {"connection": "classic", "transport": "udp", "unit": "mm"}
    options = VrpnServerOptions(bodies=("Thigh",), unit="mm", segment_bytes=7)
