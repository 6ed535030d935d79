"""`jointfit probe` and `jointfit doctor` on a real CAN interface."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.discovery import find_can_interfaces, listen_can
from jointfit_daemon.tools.doctor._can_checks import check_can
from jointfit_daemon.tools.doctor._host import Host
from jointfit_protocols.xcdi import id_block
from jointfit_simulators.devices import XcdiDevice, XcdiDeviceOptions
from tests.vm.vcan_link import LINK, NEEDS_VCAN, ip

if TYPE_CHECKING:
    from jointfit_simulators.wires import PythonCanWire

pytestmark = NEEDS_VCAN
Q = (1.0, 0.0, 0.0, 0.0)


async def test_two_sensors_on_one_interface_are_recognized(wire: PythonCanWire) -> None:
    sensors = [XcdiDevice(wire, XcdiDeviceOptions(ids=id_block(base))) for base in (0, 0x100)]
    listening = asyncio.create_task(asyncio.to_thread(listen_can, LINK, listen_s=1.0))
    while not listening.done():
        for sensor in sensors:
            sensor.push(time.monotonic_ns(), Q)
        await asyncio.sleep(0.01)

    found = await listening
    assert found.fault is None
    assert found.error_frames == 0
    quaternions = [device.settings["ids"]["quaternion"] for device in found.devices]
    assert quaternions == [0x21, 0x121]
    for device in found.devices:
        assert device.rate_hz == pytest.approx(100, rel=0.5)
    assert {each.id for each in found.identifiers} >= {0x05, 0x06, 0x21, 0x105, 0x106, 0x121}


def test_an_interface_is_found_with_its_state_and_is_down_when_it_is() -> None:
    (found,) = [each for each in find_can_interfaces() if each.name == LINK]
    assert (found.kind, found.up, found.bitrate) == ("vcan", True, None)
    (sound,) = check_can(Host(Path("/")), {LINK: 1_000_000})
    assert sound.level == "ok"

    ip("set", LINK, "down")
    (down,) = check_can(Host(Path("/")), {LINK: 1_000_000})
    assert (down.level, down.remedy) == ("error", f"sudo ip link set {LINK} up")
    fault = listen_can(LINK, listen_s=0.1).fault
    assert fault is not None
    assert "is down" in fault


def test_an_interface_that_does_not_exist_is_absent() -> None:
    (absent,) = check_can(Host(Path("/")), {"can9": 1_000_000})
    assert absent.level == "error"
    assert LINK in absent.text
    fault = listen_can("can9", listen_s=0.1).fault
    assert fault is not None
    assert fault.startswith("can9: no such CAN interface")
