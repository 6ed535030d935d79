"""Conformance tests of the driver of LSL streams, with real outlets of liblsl."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_drivers.lsl_markers import LslMarkersMocap, LslMarkersSettings
from jointfit_simulators._contract_fixtures import orientation
from jointfit_simulators.devices import LslServer, LslServerOptions
from tests.drivers.motion_capture.mocap_contract import MocapContract

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_daemon.model import MocapFrame

pytestmark = [pytest.mark.real_time, pytest.mark.usefixtures("lsl_network")]

SOURCE = f"contract-{os.getpid()}"
"""Identifier of the streams of this process; other processes of this host may have streams."""


class TestLslMarkers(MocapContract):
    registered_as = "lsl-markers"
    # The outlet is in this process, and closes its side later: see test_lsl_session.
    test_cancelling_closes_all_descriptors_and_tasks = None  # type: ignore[assignment]
    options = LslServerOptions(markers=("T1",), bodies=("Thigh",), unit="mm", source_id=SOURCE)

    @override
    def make_server(self) -> LslServer:
        return LslServer(self.options)

    @override
    def make_driver(self, folder: Path) -> Driver:
        table: dict[str, Any] = {"driver": "lsl-markers", "source_id": SOURCE}
        body = {"rigid_body": {"thigh": "Thigh"}, "silence_s": 0.5}
        return LslMarkersMocap(LslMarkersSettings.model_validate(table | body))

    @override
    def make_wrong_device(self, folder: Path) -> LslServer:
        text = LslServerOptions(markers=("T1",), source_id=SOURCE, channel_format="string")
        return self.opened(LslServer(text))

    @override
    def send(self, device: LslServer, number: int) -> None:
        pose = ((0.1, 0.2, 0.001 * (number + 1)), orientation(number))
        device.push(0, {}, {"Thigh": pose})

    @override
    def matches(self, number: int, measurement: MocapFrame) -> bool:
        q = measurement.body_orientations[0]
        same = abs(sum(a * b for a, b in zip(q, orientation(number), strict=True))) > 1 - 1e-9
        return bool(same and abs(measurement.body_positions[0, 2] - 0.001 * (number + 1)) < 1e-9)
