"""Common base of the contract tests of all motion-capture drivers."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import pytest
from typing_extensions import override

from jointfit_daemon.driver import find_driver
from jointfit_daemon.model import MocapFrame
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import RigidBodyAsset, TextServer
from jointfit_simulators.driver_contract import DriverContract

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

THIGH = RigidBodyAsset("Thigh", ("T1", "T2", "T3"), 1)

Device = TypeVar("Device")


class MocapContract(DriverContract):
    """A server with one body and one marker, which move with the number of the sample."""

    measurement = MocapFrame
    has_noise = False  # checksums of UDP and TCP detect damage before the driver sees it
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
    port_key: ClassVar[str] = "command_port"
    keys: ClassVar[dict[str, Any]] = {"markers": {"thigh": THIGH.markers}}
    """Keys of [mocap] besides the address of the server."""
    _devices: list[Any]

    @pytest.fixture(autouse=True)
    def _close(self) -> Iterator[None]:
        self._devices = []
        yield
        for device in self._devices:
            device.unplug()

    def opened(self, device: Device) -> Device:
        """Return a device that is unplugged after the test."""
        self._devices.append(device)
        return device

    @abstractmethod
    def make_server(self) -> Any:
        """Return the simulated server."""

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> Any:
        return self.opened(self.make_server())

    @override
    def make_driver(self, folder: Path) -> Driver:
        assert self.registered_as is not None
        driver: Any = find_driver(self.registered_as)
        table = {"driver": self.registered_as, "server": "127.0.0.1", "silence_s": 0.5}
        if self._devices:
            table[self.port_key] = self._devices[-1].command_port
        made: Driver = driver(driver.Settings.model_validate(table | self.keys))
        return made

    @override
    def make_wrong_device(self, folder: Path) -> Any:
        return self.opened(TextServer(b"HTTP/1.1 400 Bad Request\r\n\r\n"))

    @override
    def send(self, device: Any, number: int) -> None:
        pose = ((0.1, 0.2, 0.001 * number), orientation(number))
        device.push(
            self.device_ns(device, number), {"T1": (1.0, 2.0, 0.001 * number)}, {"Thigh": pose}
        )

    @override
    def matches(self, number: int, measurement: MocapFrame) -> bool:
        q = measurement.body_orientations[0]
        same = abs(sum(a * b for a, b in zip(q, orientation(number), strict=True))) > 1 - 1e-6
        return bool(same and abs(measurement.markers[0, 2] - 0.001 * number) < 1e-6)
