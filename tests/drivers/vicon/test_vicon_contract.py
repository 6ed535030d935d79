"""Conformance tests of the Vicon driver."""

from __future__ import annotations

import pytest
from typing_extensions import override

from jointfit_simulators.devices import ViconServer, ViconServerOptions
from tests.drivers.motion_capture.mocap_contract import THIGH, MocapContract

pytestmark = pytest.mark.real_time


class TestVicon(MocapContract):
    registered_as = "vicon"
    options = ViconServerOptions(bodies=(THIGH,), rate_hz=100)

    @override
    def make_server(self) -> ViconServer:
        return ViconServer(self.options)


class TestViconLightSegments(TestVicon):
    options = ViconServerOptions(bodies=(THIGH,), rate_hz=100, light=True, up_axis="y", pieces=4)
