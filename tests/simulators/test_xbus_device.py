"""Simulated Xbus device: messages of real devices, without a driver."""

from __future__ import annotations

import asyncio
import itertools
import os
import select
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_protocols.xbus import XbusCodec, XbusMessage, XbusMessageId, encode
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import Item, decode_item, split
from jointfit_simulators.devices import XbusDevice, XbusDeviceOptions
from jointfit_simulators.devices._xbus_device import WAKE_UP_S

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

IDENTITY = (1.0, 0.0, 0.0, 0.0)
PERIOD_NS = 10_000_000


class Host:
    """Host end of the line, without a driver."""

    def __init__(self, link: Path, **options: Any) -> None:
        self.device = XbusDevice(link, options=XbusDeviceOptions(**options))
        self._fd = os.open(link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._decoder = XbusCodec()

    def close(self) -> None:
        os.close(self._fd)
        self.device.unplug()

    def receive(self) -> list[XbusMessage]:
        data = b""
        while select.select([self._fd], [], [], 0.05)[0]:  # until the kernel delivers no more
            data += os.read(self._fd, 65536)
        return [event for event in self._decoder.feed(data) if isinstance(event, XbusMessage)]

    async def ask(self, mid: int, data: bytes = b"") -> list[XbusMessage]:
        os.write(self._fd, encode(mid, data))
        await asyncio.sleep(0.02)
        return self.receive()

    def items(self) -> list[dict[int, Any]]:
        return [
            {data_id: decode_item(data_id, raw) for data_id, raw in split(message.data) or []}
            for message in self.receive()
        ]


@pytest.fixture
def host(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Host]:
    made = Host(tmp_path / "imu", **getattr(request, "param", {}))
    yield made
    made.close()


def streams(**options: Any) -> pytest.MarkDecorator:
    more = {"measures_at_once": True, **options}
    return pytest.mark.parametrize("host", [more], indirect=True, ids=[""])


async def test_invalid_output_configuration_returns_error_21(host: Host) -> None:
    serve = asyncio.create_task(host.device.run())
    for outputs in ([(0x7777, 100)], [(0x2010, 401)]):
        (reply,) = await host.ask(XbusMessageId.OUTPUT_CONFIGURATION, setup.encode_outputs(outputs))
        assert (reply.mid, reply.data) == (XbusMessageId.ERROR, b"\x21")
    assert host.device.flash_writes == 0
    serve.cancel()
    await asyncio.wait({serve})


@pytest.mark.parametrize(("asked", "used"), [(100, 100), (120, 100), (0xFFFF, 400), (150, 133)])
async def test_acknowledgement_contains_the_rates_in_use(host: Host, asked: int, used: int) -> None:
    serve = asyncio.create_task(host.device.run())
    wanted = setup.encode_outputs([(0x1020, 100), (0x2010, asked)])
    (reply,) = await host.ask(XbusMessageId.OUTPUT_CONFIGURATION, wanted)
    assert setup.decode_outputs(reply.data) == ((0x1020, 0xFFFF), (0x2010, used))
    assert host.device.flash_writes == 1
    serve.cancel()
    await asyncio.wait({serve})


@pytest.mark.parametrize("host", [{"wakes_up": True}], indirect=True, ids=[""])
async def test_device_measures_if_wake_up_is_not_acknowledged(host: Host) -> None:
    serve = asyncio.create_task(host.device.run())
    await asyncio.sleep(0.05)
    assert [message.mid for message in host.receive()] == [XbusMessageId.WAKE_UP]
    before = host.device.streaming
    await asyncio.sleep(WAKE_UP_S)
    assert (before, host.device.streaming) == (False, True)
    serve.cancel()
    await asyncio.wait({serve})


@pytest.mark.parametrize("host", [{"wakes_up": True}], indirect=True, ids=[""])
async def test_device_enters_configuration_if_wake_up_is_acknowledged(host: Host) -> None:
    serve = asyncio.create_task(host.device.run())
    await asyncio.sleep(0.05)
    await host.ask(XbusMessageId.WAKE_UP_ACK)
    await asyncio.sleep(WAKE_UP_S)
    assert not host.device.streaming
    serve.cancel()
    await asyncio.wait({serve})


@streams(product_code="MTi-300-AHRS", first_tick=863_999_850)
def test_device_with_a_day_clock_wraps_at_midnight(host: Host) -> None:
    for number in range(3):
        host.device.push(number * PERIOD_NS, IDENTITY)
    assert [items[Item.SAMPLE_TIME_FINE] for items in host.items()] == [
        863_999_850, 863_999_950, 50,
    ]  # fmt: skip


@streams(gnss=True)
def test_gnss_messages_increment_the_counter_without_an_orientation(host: Host) -> None:
    for number in range(40):
        host.device.push(number * PERIOD_NS, IDENTITY)
    found = host.items()
    gnss = [items for items in found if Item.QUATERNION not in items]
    times = [items[Item.SAMPLE_TIME_FINE] for items in found]
    assert len(found) - len(gnss) == host.device.sent == 40
    assert len(gnss) == 3
    assert [items[Item.PACKET_COUNTER] for items in found] == list(range(43))
    assert any(after < before for before, after in itertools.pairwise(times))


@streams(first_counter=65534)
def test_lost_messages_increment_the_counter_and_are_not_sent(host: Host) -> None:
    host.device.push(0, IDENTITY)
    host.device.lose(2)
    for number in range(1, 4):
        host.device.push(number * PERIOD_NS, IDENTITY)
    assert [items[Item.PACKET_COUNTER] for items in host.items()] == [65534, 1]
    assert host.device.sent == 2


@streams()
def test_full_line_loses_complete_samples(host: Host) -> None:
    for number in range(5000):
        host.device.push(number * PERIOD_NS, IDENTITY)
    assert host.device.sent < 5000
    found: list[dict[int, Any]] = []
    while more := host.items():
        found += more
    host.device.push(5000 * PERIOD_NS, IDENTITY)
    found += host.items()
    assert len(found) == host.device.sent
    assert host._decoder.discarded == host._decoder.pending == 0


def test_device_in_configuration_sends_nothing(host: Host) -> None:
    host.device.push(0, IDENTITY)
    assert host.items() == []
    assert host.device.sent == 0
