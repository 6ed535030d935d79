"""Older Xbus devices, which send MTData: conformance, decoded orientations, and configuration."""

from __future__ import annotations

import asyncio
import struct
from typing import TYPE_CHECKING, Any, ClassVar

import pytest
from pydantic import ValidationError
from typing_extensions import override

from jointfit_daemon.driver import DeviceMisconfiguredError
from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample
from jointfit_drivers.xbus import XbusImu, XbusSettings
from jointfit_protocols.xbus import XbusMessageId, encode
from jointfit_protocols.xbus.mtdata import (
    EULER,
    FORMAT_SHIFT,
    MATRIX,
    NED,
    SAMPLE_COUNTER,
    MTDataLayout,
    OutputMode,
)
from jointfit_protocols.xbus.mtdata2 import Item
from jointfit_simulators._contract_fixtures import orientation, serve_device
from jointfit_simulators.devices import XbusDevice, XbusDeviceOptions
from jointfit_simulators.devices._inertial_signals import InertialSignals
from jointfit_simulators.devices._xbus_legacy import legacy_content
from jointfit_simulators.driver_contract import DriverContract
from tests.drivers.driver_run import TextDevice

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.driver import Driver
    from jointfit_daemon.model import Decoded
    from jointfit_simulators.imu_device import WireNoise

MODE = int(OutputMode.CALIBRATED | OutputMode.ORIENTATION)


def settings(folder: Path | None = None, **more: Any) -> XbusSettings:
    port = "/dev/ttyS0" if folder is None else str(folder / "imu")
    table: dict[str, Any] = {"id": "S1", "segment": "thigh", "driver": "xbus", "port": port}
    table |= {"baud": 115_200, "silence_s": 0.5, "format": "mtdata", **more}
    return XbusSettings.model_validate(table)


@pytest.mark.real_time
class TestXbusMTData(DriverContract):
    registered_as = "xbus"
    layout: ClassVar[MTDataLayout] = MTDataLayout(MODE, SAMPLE_COUNTER)

    @override
    def make_device(self, folder: Path, wire_noise: WireNoise) -> XbusDevice:
        options = XbusDeviceOptions(legacy=self.layout)
        return XbusDevice(folder / "imu", options=options, wire_noise=wire_noise)

    @override
    def make_driver(self, folder: Path) -> Driver:
        return XbusImu(settings(folder))

    @override
    def make_wrong_device(self, folder: Path) -> TextDevice:
        return TextDevice(folder / "imu")


def messages(layout: MTDataLayout, world: Any, numbers: range) -> Iterator[bytes]:
    for number in numbers:
        content = legacy_content(layout, world, number, orientation(number), InertialSignals())
        yield encode(XbusMessageId.MT_DATA, content)


def decoded(*wires: bytes, **more: Any) -> list[Decoded]:
    decoder = XbusImu(settings(**more)).decoder()
    return [item for wire in wires for item in decoder.feed(Chunk(0, wire))]


@pytest.mark.parametrize("kind", [0, EULER, MATRIX])
@pytest.mark.parametrize("reals", [0, 1, 2])
@pytest.mark.parametrize(("world", "ned"), [("NWU", 0), ("ENU", 0), ("NWU", NED)])
def test_every_form_of_orientation_is_canonical(
    kind: int, reals: int, world: str, ned: int
) -> None:
    layout = MTDataLayout(MODE, SAMPLE_COUNTER | kind | reals << FORMAT_SHIFT | ned)
    wires = messages(layout, world, range(9))
    keys = {"output_mode": MODE, "output_settings": layout.settings, "legacy_world": world}
    found = [item for item in decoded(*wires, **keys) if isinstance(item, ImuSample)]
    assert [sample.counter for sample in found] == list(range(9))
    for number, sample in enumerate(found):
        assert sample.ticks is None
        q = orientation(number)
        dot = sum(a * b for a, b in zip(sample.q_world_sensor, q, strict=True))
        assert abs(dot) == pytest.approx(1.0, abs=1e-6)


def test_the_replies_of_the_device_define_the_fields() -> None:
    replies = [
        encode(XbusMessageId.OUTPUT_MODE_ACK, MODE.to_bytes(2, "big")),
        encode(XbusMessageId.OUTPUT_SETTINGS_ACK, SAMPLE_COUNTER.to_bytes(4, "big")),
    ]
    wires = list(messages(MTDataLayout(MODE, SAMPLE_COUNTER), "NWU", range(3)))
    found = decoded(*replies, *wires)
    assert sum(isinstance(item, ImuSample) for item in found) == 3

    unknown = decoded(*wires)
    assert [item.text for item in unknown if isinstance(item, DeviceEvent)] == [
        "output mode and settings of MTData are unknown: set output_mode and output_settings"
    ]


def test_a_device_of_the_other_format_is_named_once() -> None:
    wires = messages(MTDataLayout(MODE, SAMPLE_COUNTER), "NWU", range(3))
    (event,) = decoded(*wires, format="mtdata2")
    assert isinstance(event, DeviceEvent)
    assert 'set format = "mtdata"' in event.text


def test_a_message_of_another_length_is_refused() -> None:
    wires = messages(MTDataLayout(MODE, SAMPLE_COUNTER), "NWU", range(1))
    (item,) = decoded(*wires, output_mode=MODE, output_settings=0)
    assert isinstance(item, Corrupt)
    assert item.reason == "MTData of 54 bytes contradicts the output mode"


@pytest.mark.parametrize(
    ("options", "keys", "text"),
    [
        ({"legacy": MTDataLayout(2, 1)}, {}, "it sends no orientation"),
        ({"legacy": MTDataLayout(6, 0)}, {}, "it sends no sample counter"),
        ({"legacy": MTDataLayout(6, 1), "legacy_hz": 50.0}, {}, "set rate_hz = 50"),
        ({"legacy": MTDataLayout(6, 1), "legacy_skip": 1}, {}, "output skip factor"),
        ({"legacy": MTDataLayout(6, 1)}, {"output_mode": 4}, "its output_mode is 0x6, not 0x4"),
        ({"legacy": MTDataLayout(6, 1)}, {"format": "mtdata2"}, 'set format = "mtdata"'),
        ({}, {}, 'set it to "mtdata2"'),
    ],
)
async def test_a_wrong_configuration_is_named_and_not_written(
    tmp_path: Path, options: dict[str, Any], keys: dict[str, Any], text: str
) -> None:
    device = XbusDevice(tmp_path / "imu", options=XbusDeviceOptions(**options))
    async with serve_device(device), asyncio.timeout(10):
        with pytest.raises(DeviceMisconfiguredError) as error:
            await XbusImu(settings(tmp_path, **keys)).run(lambda _: None)
    assert text in str(error.value)
    assert device.flash_writes == 0


@pytest.mark.parametrize(
    ("keys", "text"),
    [
        ({"orientation": "gateway"}, "MTData has no device time"),
        ({"persist": True}, "is never written"),
        ({"sync": []}, "sync lines need MTData2"),
        ({"format": "mtdata2", "output_mode": 6}, "only MTData has this key"),
    ],
)
def test_keys_that_mtdata_does_not_allow_are_refused(keys: dict[str, Any], text: str) -> None:
    if "orientation" in keys:
        pytest.importorskip("vqf")
    with pytest.raises(ValidationError, match=text):
        settings(**keys)


def test_a_matrix_that_is_no_rotation_is_refused_by_its_norm() -> None:
    layout = MTDataLayout(int(OutputMode.ORIENTATION), SAMPLE_COUNTER | MATRIX)
    wire = layout.write({Item.ROTATION_MATRIX: (0.0,) * 9, Item.PACKET_COUNTER: 1})
    keys = {"output_mode": layout.mode, "output_settings": layout.settings}
    (item,) = decoded(encode(XbusMessageId.MT_DATA, wire), **keys)
    assert isinstance(item, Corrupt)
    assert item.reason == "quaternion norm is not 1"


def test_the_configuration_message_of_a_capture_defines_the_fields() -> None:
    layout = MTDataLayout(MODE, SAMPLE_COUNTER | MATRIX)
    body = struct.pack(">IHHHHI80xH", 1, 1152, 0, 0, 0, 0, 1)
    body += struct.pack(">IHHI8x", 1, layout.size, layout.mode, layout.settings)
    assert len(body) == 118
    wires = list(messages(layout, "NWU", range(5)))
    found = decoded(encode(XbusMessageId.CONFIGURATION, body), *wires)
    assert sum(isinstance(item, ImuSample) for item in found) == 5

    several = body[:96] + b"\0\2" + body[98:] + body[98:]
    for other in (several, body[:-1], b""):
        found = decoded(encode(XbusMessageId.CONFIGURATION, other), *wires)
        assert not any(isinstance(item, ImuSample) for item in found)
