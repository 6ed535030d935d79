"""Recording of an Xbus device, replayed into a pty and read by the whole driver."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.model import DeviceEvent, ImuSample
from jointfit_drivers.xbus import XbusImu, XbusSettings
from jointfit_protocols.xbus import XbusCodec, XbusMessage, encode
from jointfit_protocols.xbus.mtdata2 import Item, decode_item, split
from jointfit_simulators.devices import XbusDevice

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.model import Decoded


class Player(XbusDevice):
    """Answers the handshake like a device, then sends recorded messages."""

    async def play(self, messages: list[XbusMessage], speed: float) -> None:
        last = None
        for message in messages:
            items = dict(split(message.data) or [])
            if Item.QUATERNION in items:  # other messages have the time of another clock
                ticks = decode_item(Item.SAMPLE_TIME_FINE, items[Item.SAMPLE_TIME_FINE])
                assert isinstance(ticks, int)
                if last is not None:
                    await asyncio.sleep((ticks - last) * 1e-4 / speed)
                last = ticks
            self._line.write(encode(message.mid, message.data, message.bid))


@pytest.mark.alone
@pytest.mark.parametrize("speed", [10.0, 1.0])
async def test_the_recording_played_into_a_pty_gives_92_samples(
    tmp_path: Path, shared_data: Path, speed: float
) -> None:
    wire = (shared_data / "imu" / "xsens" / "5.output.bin").read_bytes()
    messages = [event for event in XbusCodec().feed(wire) if isinstance(event, XbusMessage)]
    device = Player(tmp_path / "imu")
    driver = XbusImu(
        XbusSettings(
            id="S1", segment="thigh", driver="xbus", port=str(tmp_path / "imu"), baud=460_800
        )
    )
    decoder = driver.decoder()
    events: list[Decoded] = []
    serve = asyncio.create_task(device.run())
    read = asyncio.create_task(driver.run(lambda chunk: events.extend(decoder.feed(chunk))))
    async with asyncio.timeout(10):
        while not device.streaming:
            await asyncio.sleep(0.005)
    await device.play(messages, speed)
    await asyncio.sleep(0.1)
    assert not read.done()
    for task in (read, serve):
        task.cancel()
    await asyncio.wait({read, serve})
    device.unplug()
    samples = [event for event in events if isinstance(event, ImuSample)]
    told = [event.kind for event in events if isinstance(event, DeviceEvent)]
    assert len(samples) == 92
    assert told.count("gap") == told.count("restart") == 0
    assert decoder.discarded_bytes == 0
    taken_s = (samples[-1].arrival_ns - samples[0].arrival_ns) / 1e9
    assert 0.8 * 0.91 / speed < taken_s < 0.91 / speed + 1.0  # a loaded host may be late
