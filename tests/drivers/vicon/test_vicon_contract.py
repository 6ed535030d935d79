"""The Vicon driver against the conformance suite of drivers."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_daemon.model import MocapFrame
from jointfit_drivers.vicon import ViconMocap, ViconSettings
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import (
    RigidBodyAsset,
    TextServer,
    ViconServer,
    ViconServerOptions,
)
from jointfit_simulators.driver_contract import DriverContract

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time

THIGH = RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1)


class TestVicon(DriverContract):
    registered_as = "vicon"
    measurement = MocapFrame
    has_noise = False  # the checksum of TCP detects damage before the driver sees it
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
    options = ViconServerOptions(bodies=(THIGH,), rate_hz=100)
    _devices: list[Any]

    @pytest.fixture(autouse=True)
    def _close(self) -> Iterator[None]:
        self._devices = []
        yield
        for device in self._devices:
            device.unplug()

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> ViconServer:
        device = ViconServer(self.options)
        self._devices.append(device)
        return device

    @override
    def make_driver(self, folder: Path) -> Driver:
        port = self._devices[-1].command_port if self._devices else 801
        settings = ViconSettings(
            driver="vicon", server="127.0.0.1", command_port=port, silence_s=0.5,
            markers={"thigh": THIGH.markers},
        )  # fmt: skip
        return ViconMocap(settings)

    @override
    def make_wrong_device(self, folder: Path) -> TextServer:
        device = TextServer(b"HTTP/1.1 400 Bad Request\r\n\r\n")
        self._devices.append(device)
        return device

    @override
    def send(self, device: ViconServer, number: int) -> None:
        pose = ((0.1, 0.2, 0.001 * number), orientation(number))
        device.push(
            self.device_ns(device, number), {"T1": (1.0, 2.0, 0.001 * number)}, {"Thigh": pose}
        )

    @override
    def matches(self, number: int, measurement: MocapFrame) -> bool:
        q = measurement.body_orientations[0]
        same = abs(sum(a * b for a, b in zip(q, orientation(number), strict=True))) > 1 - 1e-6
        return bool(same and abs(measurement.markers[0, 2] - 0.001 * number) < 1e-6)


class TestViconLightSegments(TestVicon):
    options = ViconServerOptions(bodies=(THIGH,), rate_hz=100, light=True, up_axis="y", pieces=4)
