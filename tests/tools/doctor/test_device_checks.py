"""`jointfit doctor` names the sensor family on a serial port, and sends nothing to the sensor."""

from __future__ import annotations

import asyncio
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import Source
from jointfit_daemon.driver import find_driver
from jointfit_daemon.tools.doctor import _device_checks
from jointfit_daemon.tools.doctor._device_checks import check_devices
from jointfit_protocols.xbus.mtdata import MTDataLayout
from jointfit_simulators.devices import XbusDevice, XbusDeviceOptions
from tests.tools.doctor.test_doctor_host import gateway

if TYPE_CHECKING:
    from jointfit_daemon.device_search import Finding

pytestmark = pytest.mark.real_time
Q = (1.0, 0.0, 0.0, 0.0)
OLDER = XbusDeviceOptions(measures_at_once=True, legacy=MTDataLayout(0x0004, 0x0001))
CURRENT = XbusDeviceOptions(measures_at_once=True)


def source(folder: Path, driver: str, **keys: Any) -> Source:
    kind = find_driver(driver)
    table = {"id": "S1", "segment": "thigh", "driver": driver, "port": str(folder / "imu")} | keys
    settings = kind.Settings.model_validate(table)
    return Source("S1", "imu", driver, settings.rate_hz, "thigh", settings, kind)


async def finding(
    folder: Path, options: XbusDeviceOptions, driver: str, monkeypatch: Any, **keys: Any
) -> Finding:
    """Return the finding about a device that sends data; require that nothing is sent to it."""
    monkeypatch.setattr(_device_checks, "_LISTEN_S", 0.3)
    device = XbusDevice(folder / "imu", options=options)
    monkeypatch.setattr(device, "_receive", lambda data: pytest.fail(f"received {data!r}"))

    async def push() -> None:
        while True:
            device.push(time.monotonic_ns(), Q)
            await asyncio.sleep(0.01)

    tasks = [asyncio.create_task(work) for work in (device.run(), push())]
    try:
        host = gateway(Path("/"))
        checked = asyncio.to_thread(
            lambda: list(check_devices(host, [source(folder, driver, **keys)]))
        )
        (found,) = await checked
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        device.unplug()
    return found


async def test_another_family_is_named_with_the_lines_to_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = await finding(tmp_path, CURRENT, "vectornav", monkeypatch)
    assert found.level == "error"
    assert 'the device on this port is "xbus" at 115200 baud, expected driver "vectornav"' in (
        found.text
    )
    assert 'set driver = "xbus" and baud = 115200' in found.remedy


async def test_the_right_family_is_ok(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = await finding(tmp_path, CURRENT, "xbus", monkeypatch)
    assert (found.level, found.remedy) == ("ok", "")
    assert '"xbus" at 115200 baud, ' in found.text


async def test_the_format_of_an_older_device_is_proposed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = await finding(tmp_path, OLDER, "xbus", monkeypatch)
    assert (found.level, found.remedy) == ("warning", 'set format = "mtdata"')
    known = await finding(tmp_path, OLDER, "xbus", monkeypatch, format="mtdata")
    assert known.level == "note", "its handshake reads the output mode"


def test_an_absent_port_is_left_to_the_checks_of_ports(tmp_path: Path) -> None:
    assert not list(check_devices(gateway(tmp_path), [source(tmp_path, "xbus")]))
