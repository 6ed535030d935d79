"""Handshake of the x-IMU3 driver with devices that have right, wrong and missing settings."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import ValidationError

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import DeviceEvent
from jointfit_daemon.tools.discovery import listen_serial
from jointfit_drivers.ximu3 import XImu3Imu, XImu3Settings, _passive_check
from jointfit_protocols.ximu3 import XImu3Codec, XImu3Reply
from jointfit_simulators.devices import XImu3Device, XImu3DeviceOptions
from tests.drivers.driver_run import DriverRun, TextDevice, serving

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.real_time

CONFIGURED: dict[str, object] = {"serial_mode": 1, "ahrs_message_rate_divisor": 4}


def device(folder: Path, stored: dict[str, object] | None = None, **more: Any) -> XImu3Device:
    options = XImu3DeviceOptions(CONFIGURED | (stored or {}), **more)
    return XImu3Device(folder / "imu", options=options)


def make(folder: Path, **keys: Any) -> XImu3Imu:
    table: dict[str, Any] = {"id": "S1", "segment": "thigh", "driver": "ximu3", "silence_s": 0.5}
    return XImu3Imu(XImu3Settings(port=str(folder / "imu"), **table | keys))


async def refusal(driver: XImu3Imu, kind: type[Exception] = DeviceMisconfiguredError) -> str:
    with pytest.raises(kind) as caught:
        async with asyncio.timeout(20):
            await driver.run(lambda _: None)
    return str(caught.value)


async def events_of(driver: XImu3Imu, count: int = 5) -> DriverRun:
    run = DriverRun(driver)
    try:
        await run.wait_for(count)
    finally:
        await run.cancel()
    return run


async def test_emitted_bytes_begin_with_the_reply_and_contain_all_settings(tmp_path: Path) -> None:
    async with serving(device(tmp_path, {"ahrs_axes_convention": 2}), feeding=True):
        await asyncio.sleep(0.05)
        run = await events_of(make(tmp_path), 20)
    codec = XImu3Codec()
    found = [message for chunk in run.chunks for message in codec.feed(chunk.data)]
    assert isinstance(found[0], XImu3Reply)
    assert found[0].key == "ahrs_axes_convention"  # the decoder needs it for the first sample
    keys = [message.key for message in found if isinstance(message, XImu3Reply)]
    assert keys == [
        "ahrs_axes_convention", "ping", "firmware_version", "hardware_version",
        "ahrs_axes_convention", "axes_alignment", "ahrs_ignore_magnetometer", "serial_mode",
        "serial_data_messages_enabled", "ahrs_message_type", "ahrs_message_rate_divisor",
    ]  # fmt: skip
    known = {
        key: value
        for event in run.events
        if isinstance(event, DeviceEvent)
        for key, value in event.data.items()
    }
    assert known["model"] == "x-IMU3"
    assert known["serial"] == "0123ABCD"
    assert known["world"] == "NED"
    assert run.decoder.discarded_bytes == 0


async def test_a_device_with_the_right_settings_is_not_written_to(tmp_path: Path) -> None:
    subject = device(tmp_path)
    before = dict(subject.settings)
    async with serving(subject, feeding=True):
        await events_of(make(tmp_path, persist=True))
    assert subject.saves == 0
    assert subject.settings == before


async def test_differences_are_named_and_not_written_without_permission(tmp_path: Path) -> None:
    subject = device(
        tmp_path, {"ahrs_message_type": 4, "ahrs_message_rate_divisor": 8, "axes_alignment": 8}
    )
    async with serving(subject):
        text = await refusal(make(tmp_path, axes_alignment=0, ignore_magnetometer=True))
    for part in (
        "/imu: ", "ahrs_message_type is 4 (earth acceleration), expected 0 (quaternion)",
        "ahrs_message_rate_divisor is 8 (50 Hz), expected 4 (100 Hz)",
        "axes_alignment is 8, expected 0", "ahrs_ignore_magnetometer is false, expected true",
        "set persist = true once",
    ):  # fmt: skip
        assert part in text
    assert subject.saves == 0
    assert subject.settings["ahrs_message_type"] == 4


async def test_a_rate_alone_is_offered_as_the_setting_it_takes(tmp_path: Path) -> None:
    """If only the rate differs, the error contains the rate of the device as a remedy."""
    async with serving(device(tmp_path, {"ahrs_message_rate_divisor": 8})):
        assert "(or set rate_hz = 50)" in await refusal(make(tmp_path))


async def test_differences_are_written_once_with_permission(tmp_path: Path) -> None:
    subject = device(tmp_path, {"ahrs_message_type": 3, "ahrs_message_rate_divisor": 0})
    driver = make(tmp_path, persist=True, rate_hz=400 / 3, ignore_magnetometer=True)
    async with serving(subject, feeding=True):
        await events_of(driver)
        await events_of(driver)
    assert subject.saves == 1
    wanted = {
        "ahrs_message_type": 0, "ahrs_message_rate_divisor": 3, "ahrs_ignore_magnetometer": True,
    }  # fmt: skip
    assert wanted.items() <= subject.settings.items()


async def test_raw_outputs_are_required_where_the_gateway_computes_the_orientation(
    tmp_path: Path,
) -> None:
    pytest.importorskip("vqf")
    subject = device(
        tmp_path, {"inertial_message_rate_divisor": 0, "magnetometer_message_rate_divisor": 0}
    )
    keys = {"orientation": "gateway", "magnetometer": True, "settle_s": 0}
    async with serving(subject, feeding=True):
        text = await refusal(make(tmp_path, **keys))
        await events_of(make(tmp_path, persist=True, **keys))
    assert "inertial_message_rate_divisor is 0 (off), expected 4 (100 Hz)" in text
    assert "magnetometer_message_rate_divisor is 0, expected 1" in text
    assert subject.saves == 1


async def test_the_serial_interface_of_a_new_device_is_dead(tmp_path: Path) -> None:
    """A new device has serial_mode = 0, so its serial interface is off."""
    async with serving(device(tmp_path, {"serial_mode": 0}), feeding=True):
        text = await refusal(make(tmp_path), DeviceLostError)
    assert "silent" in text
    assert "set serial_mode = 1 over USB once" in text


async def test_usb_needs_no_serial_interface(tmp_path: Path) -> None:
    subject = device(tmp_path, {"serial_mode": 0}, interface="USB")
    async with serving(subject, feeding=True):
        await events_of(make(tmp_path, transport="usb"))
        assert 'set transport = "usb"' in await refusal(make(tmp_path))
    dead = device(tmp_path, {"usb_data_messages_enabled": False}, interface="USB")
    async with serving(dead):
        text = await refusal(make(tmp_path, transport="usb"), DeviceMisconfiguredError)
    assert "usb_data_messages_enabled is false, expected true" in text


async def test_another_speed_is_found_and_named(tmp_path: Path) -> None:
    async with serving(device(tmp_path, baud=460_800), feeding=True):
        text = await refusal(make(tmp_path))
    assert "115200 baud" in text
    assert "set baud = 460800" in text


async def test_another_kind_of_device_is_named(tmp_path: Path) -> None:
    async with serving(TextDevice(tmp_path / "imu")):
        text = await refusal(make(tmp_path))
    assert "not an x-IMU3" in text
    assert "correct `port` or `driver`" in text


async def test_a_device_without_the_wire_from_the_host_is_named(tmp_path: Path) -> None:
    async with serving(device(tmp_path, answers=False), feeding=True):
        text = await refusal(make(tmp_path), DeviceLostError)
        await events_of(make(tmp_path, passive=True))
    assert "does not answer commands" in text
    assert "passive = true" in text


async def test_unknown_firmware_and_worlds_are_named(tmp_path: Path) -> None:
    async with serving(device(tmp_path, missing=("ahrs_message_type", "hardware_version"))):
        text = await refusal(make(tmp_path))
    assert "firmware v1.3.0 does not have ahrs_message_type (Unknown command)" in text
    assert "hardware_version" not in text
    async with serving(device(tmp_path, {"ahrs_axes_convention": 3})):
        assert "ahrs_axes_convention is 3, expected 0 (NWU)" in await refusal(make(tmp_path))


async def test_too_slow_a_line_is_refused(tmp_path: Path) -> None:
    async with serving(device(tmp_path)):
        text = await refusal(make(tmp_path, rate_hz=400, baud=57_600))
    assert "400 Hz need 104000 bit/s, baud = 57600" in text


@pytest.fixture
def short_listening(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_passive_check, "_LISTEN_S", 0.3)


@pytest.mark.usefixtures("short_listening")
async def test_a_passive_driver_sends_nothing_and_names_other_outputs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("vqf")
    subject = device(tmp_path, {"ahrs_message_rate_divisor": 0, "inertial_message_rate_divisor": 4})
    received: list[bytes] = []
    monkeypatch.setattr(subject, "_receive", received.append)
    async with serving(subject, feeding=True):
        text = await refusal(make(tmp_path, passive=True))
        await events_of(make(tmp_path, passive=True, orientation="gateway", settle_s=0))
    assert " I, " in text
    assert 'expected Q, R or A (orientation): set orientation = "gateway"' in text
    assert received == []


@pytest.mark.usefixtures("short_listening")
async def test_a_passive_driver_names_the_settings_that_send_the_expected_messages(
    tmp_path: Path,
) -> None:
    pytest.importorskip("vqf")
    gateway = {"passive": True, "orientation": "gateway", "settle_s": 0}
    inertial = "inertial_message_rate_divisor to 400 divided by rate_hz"
    stored: dict[str, object] = {"inertial_message_rate_divisor": 0}
    async with serving(device(tmp_path, stored), feeding=True):
        text = await refusal(make(tmp_path, **gateway))
    assert f'I (inertial): set orientation = "device", or in the device {inertial}' in text

    async with serving(device(tmp_path, stored | {"ahrs_message_type": 3}), feeding=True):
        text = await refusal(make(tmp_path, **gateway))
        assert f"expected I (inertial): set in the device {inertial}" in text
        text = await refusal(make(tmp_path, passive=True))
        assert "set in the device ahrs_message_type to 0 and ahrs_message_rate_divisor to" in text


@pytest.mark.usefixtures("short_listening")
async def test_a_passive_driver_names_a_wrong_speed_and_silence(tmp_path: Path) -> None:
    async with serving(device(tmp_path, baud=460_800), feeding=True):
        text = await refusal(make(tmp_path, passive=True))
    assert "but no message of an x-IMU3: correct `baud`" in text
    async with serving(device(tmp_path)):
        assert "silent for 0.5 s" in await refusal(make(tmp_path, passive=True), DeviceLostError)


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"rate_hz": 120}, "expected 400 Hz divided by a whole number: 100 or 133.333 Hz"),
        ({"rate_hz": 500}, "expected 400 Hz divided by a whole number: 400 Hz"),
        ({"passive": True, "persist": True}, "persist: a passive driver sends nothing"),
        ({"passive": True, "axes_alignment": 0}, "axes_alignment: a passive driver sends nothing"),
        ({"axes_alignment": 24}, "less than or equal to 23"),
        ({"magnetometer": True}, 'needs orientation = "gateway"'),
        ({"port": "ttyUSB0"}, "expected the path of a serial port"),
    ],
)
def test_settings_that_no_device_has_are_refused(
    tmp_path: Path, keys: dict[str, Any], text: str
) -> None:
    table = {"id": "S1", "segment": "thigh", "driver": "ximu3", "port": "/dev/ttyUSB0"}
    with pytest.raises(ValidationError) as caught:
        XImu3Settings.model_validate(table | keys)
    assert text in str(caught.value)


def test_any_rate_is_accepted_of_a_device_that_is_listened_to(tmp_path: Path) -> None:
    make(tmp_path, passive=True, rate_hz=120)


async def test_probe_recognises_the_device_without_writing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    subject = device(tmp_path, baud=115_200)
    received: list[bytes] = []
    monkeypatch.setattr(subject, "_receive", received.append)
    async with serving(subject, feeding=True):
        found = await asyncio.to_thread(listen_serial, str(tmp_path / "imu"), listen_s=0.5)
    assert found.baud == 115_200
    (known,) = found.devices
    assert known.driver == "ximu3"
    assert known.discarded_bytes < 100  # the rest of a message at the start
    assert received == []
