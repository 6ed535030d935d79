"""Conformance tests of the QTM driver."""

from __future__ import annotations

from typing import Any, ClassVar

import pytest
from typing_extensions import override

from jointfit_simulators.devices import QtmServer, QtmServerOptions
from tests.drivers.motion_capture.mocap_contract import THIGH, MocapContract

pytestmark = pytest.mark.real_time


class TestQtmOverUdp(MocapContract):
    registered_as = "qtm"
    options = QtmServerOptions(bodies=(THIGH,))

    @override
    def make_server(self) -> QtmServer:
        return QtmServer(self.options)


class TestQtmOverTcp(TestQtmOverUdp):
    options = QtmServerOptions(bodies=(THIGH,), newest=(1, 21), camera_time=False, pieces=3)
    keys: ClassVar[dict[str, Any]] = MocapContract.keys | {"transport": "tcp"}


class TestQtmInParts(TestQtmOverUdp):
    options = QtmServerOptions(bodies=(THIGH,), split=True, up_axis="y")
