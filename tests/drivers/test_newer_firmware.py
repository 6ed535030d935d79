"""Devices with newer firmware: a warning with version and remedy, and use of known parts."""

from __future__ import annotations

import asyncio
import struct
from binascii import crc_hqx
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

from jointfit_daemon.driver import DeviceMisconfiguredError, find_driver
from jointfit_daemon.model import Chunk, DeviceEvent
from jointfit_drivers.newer_firmware import NewerFirmwareDetector, NewestKnown
from jointfit_drivers.qtm import QtmMocap
from jointfit_protocols import bno085, mip, qtm, vicon, witmotion, xbus
from jointfit_protocols.mip.commands import DeviceInformation
from jointfit_simulators import devices
from tests.drivers.driver_run import DriverRun, serving
from tests.drivers.motion_capture.mocap_run import MocapRun, answering
from tests.drivers.natnet import feeder as natnet_feeder
from tests.drivers.qtm import feeder as qtm_feeder
from tests.drivers.qtm.serving import made as qtm_server
from tests.drivers.qtm.serving import served as qtm_served
from tests.drivers.qtm.test_qtm_session import settings_of as qtm_settings
from tests.drivers.vicon import feeder as vicon_feeder

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from jointfit_simulators.imu_device import WireNoise

S = 1_000_000_000
UPDATE = "update jointfitd"


def vectornav_of_group_8() -> bytes:
    """Return a binary output whose header announces a group that no manual described."""
    body = b"\x80\x01" + b"\x01\x00" + struct.pack("<Q", 1)
    return b"\xfa" + body + struct.pack(">H", crc_hqx(body, 0))


def mip_info(firmware: int) -> DeviceInformation:
    return DeviceInformation(
        firmware, "3DM-CV7-AHRS", "6286-9910", "6286.00042", "I03A", "5g, 500dps"
    )


class Newer(NamedTuple):
    """One device family, with the messages of a newer device."""

    driver: str
    make: Callable[[Path, WireNoise], Any]
    unknown: bytes
    """Message of unknown content, which follows each message of the device."""
    named: str
    """Name of the unknown message in the warning."""
    version: str | None
    """Version that the device reports; None for a family without version."""
    keys: Any = {}  # noqa: RUF012 - never changed


FAMILIES = (
    Newer(
        "xbus",
        lambda link, noise: devices.XbusDevice(
            link, options=devices.XbusDeviceOptions(firmware=(2, 0, 1)), wire_noise=noise
        ),
        xbus.encode(0x77, b"\x01"), "message 0x77", "2.0.1", {"persist": True},
    ),
    Newer(
        "mip",
        lambda link, noise: devices.MipDevice(
            link, options=devices.MipDeviceOptions(info=mip_info(2001)), wire_noise=noise
        ),
        mip.encode(0x82, ((0x7E, b"\0" * 4),)), "field 0x7E of data set 0x82", "2.0.01",
    ),
    Newer(
        "vectornav",
        lambda link, noise: devices.VectorNavDevice(
            link, options=devices.VectorNavDeviceOptions(firmware="4.0.0.0"), wire_noise=noise
        ),
        vectornav_of_group_8(), "binary outputs of", "4.0.0.0",
    ),
    Newer(
        "ximu3",
        lambda link, noise: devices.XImu3Device(
            link,
            options=devices.XImu3DeviceOptions({
                "serial_mode": 1, "ahrs_message_rate_divisor": 4, "firmware_version": "v2.0.0",
            }),
            wire_noise=noise,
        ),
        b"\xda" + struct.pack("<Q4f", 1_000, 1.0, 2.0, 3.0, 4.0) + b"\n",
        "messages Z with 4 values", "v2.0.0",
    ),
    Newer(
        "witmotion", lambda link, noise: devices.WitMotionDevice(link, wire_noise=noise),
        witmotion.encode(0x5D, b"\0" * 8), "frames 0x5D", None,
    ),
    Newer(
        "bno085",
        lambda link, noise: devices.Bno085Device(
            link, options=devices.Bno085DeviceOptions(firmware=(4, 0, 0)), wire_noise=noise
        ),
        bno085.encode_shtp(3, 0, b"\x5a" + b"\0" * 9), "reports 0x5A", "4.0.0",
        {"baud": 3_000_000},
    ),
)  # fmt: skip


@pytest.mark.real_time
@pytest.mark.parametrize("family", FAMILIES, ids=lambda one: one.driver)
async def test_a_newer_device_is_named_and_its_known_contents_are_used(
    family: Newer, tmp_path: Path
) -> None:
    device = family.make(tmp_path / "imu", lambda wire: wire + family.unknown)
    kind = find_driver(family.driver)
    table = {"id": "S1", "segment": "thigh", "driver": family.driver, "silence_s": 0.5}
    table |= {"port": str(tmp_path / "imu")} | family.keys
    driver = kind(kind.Settings.model_validate(table))
    async with serving(device, feeding=True):
        run = DriverRun(driver)
        await run.wait_for(15)
        await run.cancel()

    found = [item for item in run.events if isinstance(item, DeviceEvent) and UPDATE in item.text]
    unknown = [item for item in found if "unknown" in item.data]
    assert len(unknown) == 1, "once, not once a message"
    assert family.named in unknown[0].text
    assert "known contents are used" in unknown[0].text
    versions = [item for item in found if item not in unknown]
    if family.version is None:
        assert not versions
        return
    assert len(versions) == 1
    assert f" {family.version} is newer than " in versions[0].text
    assert family.version in unknown[0].text


async def test_a_qtm_without_an_old_protocol_is_named_by_its_version() -> None:
    server = qtm_server(oldest=(1, 30), newest=(1, 31))
    async with qtm_served(server, sends=False):
        with pytest.raises(DeviceMisconfiguredError) as caught:
            async with asyncio.timeout(10):
                await QtmMocap(qtm_settings(server.command_port)).run(lambda _: None)
    assert "QTM Version is 2026.1" in str(caught.value)
    assert "1.19 to 1.25" in str(caught.value)
    assert "update jointfitd" in str(caught.value)


@pytest.mark.real_time
async def test_a_newer_vrpn_server_is_used_with_a_warning() -> None:
    server = devices.VrpnServer(devices.VrpnServerOptions(version=(7, 40), bodies=("Thigh",)))
    kind = find_driver("vrpn")
    table = {"driver": "vrpn", "server": "127.0.0.1", "silence_s": 0.5}
    table |= {"rigid_body": {"thigh": "Thigh"}}

    def push() -> None:
        server.push(0, {}, {"Thigh": ((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))})

    async with answering(server, push):
        driver = kind(kind.Settings.model_validate(table | {"port": server.command_port}))
        reading = MocapRun(driver)
        async with reading.running():
            await reading.until(lambda: bool(reading.frames))
    (text,) = [text for text in reading.texts() if UPDATE in text]
    assert text.startswith("VRPN 07.40 is newer than 7.38, the newest known version")


def test_newer_messages_of_the_other_servers_are_named() -> None:
    seen = natnet_feeder.Feeder()
    seen(natnet_feeder.INFO._replace(natnet_version=(4, 3, 0, 0)))
    texts = [item.text for item in seen.events if isinstance(item, DeviceEvent)]
    assert any(text.startswith("NatNet 4.3 is newer than 4.2") for text in texts)

    known = qtm_feeder.ready()
    known(qtm.Event(16), qtm.Event(99), qtm.Event(99))
    assert [text for text in known.texts("warning") if UPDATE in text] == [
        "the device sends event 99, which jointfitd does not know (firmware not reported); it "
        "is ignored, known contents are used: update jointfitd, or disable this output with QTM"
    ]

    vicon_seen = vicon_feeder.ViconFeeder()
    vicon_seen(vicon_feeder.static(vicon.ObjectEnums(frozenset((1, 2, 5, 9, 77, 78)))))
    (text,) = [text for text in vicon_seen.texts("warning") if UPDATE in text]
    assert "sends objects 77, 78," in text

    older = vicon_feeder.ready()
    latency = vicon.OpaqueObject(vicon.ObjectId.LATENCY_INFO, b"\1\0\0\0")
    (frame,) = older.frames(vicon_feeder.frame(1, latency, vicon_feeder.segments(1, 100, 200, 300)))
    assert frame.body_positions[0].tolist() == [0.1, 0.2, 0.3]
    (text,) = [text for text in older.texts("warning") if UPDATE in text]
    assert "object 26 in a shorter layout" in text


def test_corrupt_messages_that_pass_a_checksum_are_not_reported() -> None:
    """An unknown message is reported only if it arrives often."""
    newer = NewerFirmwareDetector(NewestKnown((1,), "MT Manager"))
    assert not [
        event for k in range(100) for event in newer.take_unknown(f"message {k % 16}", k * 20 * S)
    ], "less often than ten times a minute"
    assert not newer.take_version("1.99.3")
    assert not newer.take_version("unknown")
    for k in range(1000):  # only a bounded number is stored
        newer.take_unknown(f"message {k}", 0)
    assert len(newer._seen) <= 16


CONTENTS = {
    "xbus item of another size": (
        "xbus", {}, xbus.encode(0x36, b"\x20\x10\x02\0\0"), "item 0x2010 of 2 bytes",
    ),
    "xbus item of unknown kind": (
        "xbus", {}, xbus.encode(0x36, b"\x99\x90\x02\0\0"), "item 0x9990",
    ),
    "mip field of another size": (
        "mip", {}, mip.encode(0x82, ((0x03, b"\0" * 4),)), "field 0x03 of 4 bytes of data set 0x82",
    ),
    "mip data set of unknown kind": (
        "mip", {}, mip.encode(0xB5, ((0x01, b"\0" * 4),)), "packets of data set 0xB5",
    ),
    "bno085 channel of unknown kind": (
        "bno085", {"baud": 3_000_000}, bno085.encode_shtp(9, 0, b"\0\0"), "packets on channel 9",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CONTENTS.values(), ids=CONTENTS)
def test_contents_of_unknown_kind_or_size_are_named_once(
    case: tuple[str, dict[str, Any], bytes, str],
) -> None:
    name, keys, unknown, content = case
    kind = find_driver(name)
    table = {"id": "S1", "segment": "thigh", "driver": name, "port": "p"} | keys
    decoder = kind(kind.Settings.model_validate(table)).decoder()
    events = [item for k in range(40) for item in decoder.feed(Chunk(k * S // 10, unknown))]
    (text,) = [
        item.text for item in events if isinstance(item, DeviceEvent) and UPDATE in item.text
    ]
    assert text.startswith(f"the device sends {content}, which jointfitd does not know")
