"""The driver of LSL streams against the conformance suite, with real outlets of liblsl."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_daemon.model import MocapFrame
from jointfit_drivers.lsl_markers import LslMarkersMocap, LslMarkersSettings
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import LslServer, LslServerOptions
from jointfit_simulators.driver_contract import DriverContract

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = [pytest.mark.real_time, pytest.mark.usefixtures("lsl_network")]

SOURCE = f"contract-{os.getpid()}"
"""Other processes of this host have streams, too."""


class TestLslMarkers(DriverContract):
    registered_as = "lsl-markers"
    measurement = MocapFrame
    has_noise = False  # TCP has a checksum
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
    # The outlet is in this process, and closes its side later: see test_lsl_session.
    test_cancelling_closes_all_descriptors_and_tasks = None  # type: ignore[assignment]
    options = LslServerOptions(markers=("T1",), bodies=("Thigh",), unit="mm", source_id=SOURCE)
    _devices: list[Any]

    @pytest.fixture(autouse=True)
    def _close(self) -> Iterator[None]:
        self._devices = []
        yield
        for device in self._devices:
            device.unplug()

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> LslServer:
        device = LslServer(self.options)
        self._devices.append(device)
        return device

    @override
    def make_driver(self, folder: Path) -> Driver:
        table: dict[str, Any] = {"driver": "lsl-markers", "source_id": SOURCE}
        body = {"rigid_body": {"thigh": "Thigh"}, "silence_s": 0.5}
        return LslMarkersMocap(LslMarkersSettings.model_validate(table | body))

    @override
    def make_wrong_device(self, folder: Path) -> LslServer:
        text = LslServerOptions(markers=("T1",), source_id=SOURCE, channel_format="string")
        device = LslServer(text)
        self._devices.append(device)
        return device

    @override
    def send(self, device: LslServer, number: int) -> None:
        pose = ((0.1, 0.2, 0.001 * (number + 1)), orientation(number))
        device.push(0, {}, {"Thigh": pose})

    @override
    def matches(self, number: int, measurement: MocapFrame) -> bool:
        q = measurement.body_orientations[0]
        same = abs(sum(a * b for a, b in zip(q, orientation(number), strict=True))) > 1 - 1e-9
        return bool(same and abs(measurement.body_positions[0, 2] - 0.001 * (number + 1)) < 1e-9)
