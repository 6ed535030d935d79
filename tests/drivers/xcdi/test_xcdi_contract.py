"""Conformance tests of the XCDI driver, over SLCAN and on an in-process bus."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest
from typing_extensions import override

from jointfit_daemon.driver import CanBusSettings
from jointfit_drivers.xcdi import XcdiIdSettings, XcdiImu, XcdiSettings
from jointfit_protocols.xcdi import id_block
from jointfit_simulators.devices import XcdiDevice, XcdiDeviceOptions
from jointfit_simulators.driver_contract import DriverContract
from jointfit_simulators.wires import PythonCanWire, SlcanAdapter
from tests.drivers.driver_run import TextDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_simulators.imu_device import WireNoise

pytestmark = pytest.mark.real_time


def settings(interface: str, channel: str, **more: Any) -> XcdiSettings:
    return XcdiSettings(
        id="S3", segment="shank", driver="xcdi", silence_s=0.4,
        can=CanBusSettings(interface=interface, channel=channel), **more,
    )  # fmt: skip


class TestXcdiOverSlcan(DriverContract):
    registered_as = "xcdi"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XcdiDevice:
        return XcdiDevice(SlcanAdapter(folder / "adapter", wire_noise=wire_noise))

    @override
    def make_driver(self, folder: Path) -> Driver:
        return XcdiImu(settings("slcan", str(folder / "adapter")))

    @override
    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "adapter")


class TestXcdiWith29BitIdsInMicrosecondsOverAMuteAdapter(TestXcdiOverSlcan):
    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XcdiDevice:
        options = XcdiDeviceOptions(
            ids=id_block(0x19FF0000), sample_time_unit="1us", byte_order="little"
        )
        adapter = SlcanAdapter(folder / "adapter", wire_noise=wire_noise, mute=True)
        return XcdiDevice(adapter, options)

    @override
    def make_driver(self, folder: Path) -> Driver:
        ids = XcdiIdSettings(
            sample_time=0x19FF0005, group_counter=0x19FF0006, quaternion=0x19FF0021
        )
        return XcdiImu(
            settings(
                "slcan",
                str(folder / "adapter"),
                ids=ids,
                extended_ids=True,
                byte_order="little",
            )
        )


class TestXcdiOnABusWithoutDescriptor(DriverContract):
    """The in-process bus of python-can, which a thread reads, as with most vendors' libraries."""

    registered_as = "xcdi"

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XcdiDevice:
        return XcdiDevice(PythonCanWire("virtual", str(folder)))

    @override
    def make_driver(self, folder: Path) -> Driver:
        return XcdiImu(settings("virtual", str(folder)))

    # An in-process bus has no noise, and devices of any kind may use it.
    test_line_noise_affects_only_damaged_samples = None  # type: ignore[assignment]
    test_wrong_device_raises_device_misconfigured = None  # type: ignore[assignment]
