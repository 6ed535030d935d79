"""The Xbus handshake with simulated devices in every state."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Any

import pytest
from pydantic import ValidationError
from typing_extensions import override

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk, DeviceEvent, ImuSample
from jointfit_drivers.xbus import XbusImu, XbusSettings
from jointfit_drivers.xbus._handshake import output_differences
from jointfit_drivers.xbus._required_outputs import required_outputs
from jointfit_protocols.xbus import XbusCodec, XbusMessage, XbusMessageId
from jointfit_protocols.xbus import configuration as setup
from jointfit_protocols.xbus.mtdata2 import Item, Precision, real_id
from jointfit_simulators.devices import XbusDevice, XbusDeviceOptions
from jointfit_simulators.wires import PtyLine
from tests.drivers.driver_run import serving

if TYPE_CHECKING:
    from pathlib import Path


pytestmark = pytest.mark.real_time


def make(folder: Path, **more: Any) -> XbusImu:
    table: dict[str, Any] = {"baud": 115_200, "silence_s": 0.5} | more
    return XbusImu(
        XbusSettings(id="S1", segment="thigh", driver="xbus", port=str(folder / "imu"), **table)
    )


async def chunks_of(driver: XbusImu, samples: int = 5) -> list[Chunk]:
    """Run the driver until it has emitted `samples`; its errors are raised."""
    chunks: list[Chunk] = []
    task = asyncio.create_task(driver.run(chunks.append))
    try:
        async with asyncio.timeout(10):
            while mids(chunks).count(XbusMessageId.MT_DATA2) < samples:
                if task.done():
                    task.result()
                await asyncio.sleep(0.005)
    finally:
        task.cancel()
        await asyncio.wait({task})
    return chunks


async def refusal(driver: XbusImu, kind: type[Exception]) -> str:
    with pytest.raises(kind) as caught:
        async with asyncio.timeout(20):
            await driver.run(lambda _: None)
    return str(caught.value)


def mids(chunks: list[Chunk]) -> list[int]:
    decoder = XbusCodec()
    return [
        event.mid
        for chunk in chunks
        for event in decoder.feed(chunk.data)
        if isinstance(event, XbusMessage)
    ]


async def test_emitted_bytes_begin_with_the_acknowledgement_and_contain_all_replies(
    tmp_path: Path,
) -> None:
    options = XbusDeviceOptions(measures_at_once=True, config_delay_s=0.1)
    device = XbusDevice(tmp_path / "imu", options=options)
    async with serving(device, feeding=True):
        await asyncio.sleep(0.05)
        chunks = await chunks_of(make(tmp_path), 20)
    found = mids(chunks)
    assert found[0] == XbusMessageId.GOTO_CONFIG_ACK
    setup_ids = found[: found.index(XbusMessageId.GOTO_MEASUREMENT_ACK)]
    assert (
        XbusMessageId.MT_DATA2 not in setup_ids
    )  # data from before the acknowledgement are discarded
    assert {
        XbusMessageId.DEVICE_ID, XbusMessageId.PRODUCT_CODE, XbusMessageId.FIRMWARE,
        XbusMessageId.FILTER_PROFILE_ACK, XbusMessageId.OUTPUT_CONFIGURATION_ACK,
    } <= set(setup_ids)  # fmt: skip
    assert setup_ids.count(XbusMessageId.ALIGNMENT_ROTATION_ACK) == 2
    assert set(found[len(setup_ids) + 1 :]) == {XbusMessageId.MT_DATA2}


async def test_a_device_that_is_right_is_not_written_to(tmp_path: Path) -> None:
    device = XbusDevice(tmp_path / "imu")
    async with serving(device, feeding=True):
        await chunks_of(make(tmp_path, persist=True))
    assert device.flash_writes == 0


async def test_a_difference_is_named_and_not_written_without_permission(tmp_path: Path) -> None:
    options = XbusDeviceOptions(outputs=((Item.QUATERNION, 50),))
    device = XbusDevice(tmp_path / "imu", options=options)
    async with serving(device):
        said = await refusal(make(tmp_path), DeviceMisconfiguredError)
    assert device.flash_writes == 0
    for part in ("/imu: ", "packet counter", "time", "50 Hz, not 100 Hz", "persist = true"):
        assert part in said


async def test_a_rate_alone_is_offered_as_the_setting_it_takes(tmp_path: Path) -> None:
    """If only the rate differs, the error contains the rate of the device as the remedy."""
    device = XbusDevice(tmp_path / "imu")
    async with serving(device):
        said = await refusal(make(tmp_path, rate_hz=200), DeviceMisconfiguredError)
    assert "set rate_hz = 100" in said


async def test_a_difference_is_written_once_with_permission(tmp_path: Path) -> None:
    options = XbusDeviceOptions(outputs=((0x2034, 50),))
    device = XbusDevice(tmp_path / "imu", options=options)
    driver = make(tmp_path, persist=True, world="NED")
    async with serving(device, feeding=True):
        await chunks_of(driver)
        await chunks_of(driver)
    assert device.flash_writes == 1
    assert device.rate_hz == 100.0
    assert (0x2014, 100) in device.outputs
    assert (Item.STATUS_WORD, 0xFFFF) in device.outputs


async def test_raw_outputs_are_written_once_where_the_gateway_computes_the_orientation(
    tmp_path: Path,
) -> None:
    pytest.importorskip("vqf")
    device = XbusDevice(tmp_path / "imu")
    asked = {"orientation": "gateway", "magnetometer": True}
    async with serving(device, feeding=True):
        said = await refusal(make(tmp_path, **asked), DeviceMisconfiguredError)
        await chunks_of(make(tmp_path, persist=True, **asked))
        await chunks_of(make(tmp_path, **asked))
    for part in ("no rate of turn (0x8020)", "no acceleration (0x4020)", "no magnetic field"):
        assert part in said
    assert device.flash_writes == 1
    assert {(Item.RATE_OF_TURN, 100), (Item.ACCELERATION, 100), (Item.MAGNETIC_FIELD, 100)} <= set(
        device.outputs
    )
    assert Item.QUATERNION not in dict(device.outputs)


def test_increments_are_accepted_if_the_device_sends_them() -> None:
    sent = ((0x1020, 0xFFFF), (0x1060, 0xFFFF), (0x8032, 100), (0x4012, 100))
    found = tuple(setup.Output(*output) for output in sent)
    needs = required_outputs("gateway", magnetometer=False)
    assert output_differences(found, 100, (), needs) == []
    assert output_differences(found, 50, (), needs) == [
        "it sends rates of turn at 100 Hz, not 50 Hz",
        "it sends accelerations at 100 Hz, not 50 Hz",
    ]


async def test_a_rate_the_device_rounds_is_named(tmp_path: Path) -> None:
    device = XbusDevice(tmp_path / "imu")
    async with serving(device):
        said = await refusal(make(tmp_path, rate_hz=120, persist=True), DeviceMisconfiguredError)
    assert "quaternions at 100 Hz, not 120 Hz" in said
    assert "set rate_hz = 100" in said


async def test_device_error_code_is_reported_as_text(tmp_path: Path) -> None:
    class Refusing(XbusDevice):
        @override
        def _output_configuration(self, data: bytes) -> tuple[int, bytes]:
            if data:
                return XbusMessageId.ERROR, b"\x21"
            return XbusMessageId.OUTPUT_CONFIGURATION_ACK, b""

    device = Refusing(tmp_path / "imu")
    async with serving(device):
        said = await refusal(make(tmp_path, persist=True), DeviceMisconfiguredError)
    assert "0x21" in said
    assert "parameter" in said


async def test_a_wrong_speed_is_named_with_the_right_one(tmp_path: Path) -> None:
    options = XbusDeviceOptions(baud=921_600, measures_at_once=True)
    device = XbusDevice(tmp_path / "imu", options=options)
    async with serving(device, feeding=True):
        said = await refusal(make(tmp_path), DeviceMisconfiguredError)
        assert device.streaming  # unchanged
    assert "set baud = 921600" in said
    assert "S1" not in said, "the log line begins with the id"


async def test_a_silent_device_at_another_speed_is_found_at_the_first_attempt(
    tmp_path: Path,
) -> None:
    device = XbusDevice(tmp_path / "imu", options=XbusDeviceOptions(baud=9_600))
    async with serving(device):
        said = await refusal(make(tmp_path), DeviceMisconfiguredError)
    assert "set baud = 9600" in said


class Queueing(XbusDevice):
    """Device that executes its requests one after another, each GoToConfig in 1.5 s."""

    asked = 0
    free_s = 0.0

    @override
    def _answer(self, message: XbusMessage) -> None:
        loop = asyncio.get_running_loop()
        self.asked += message.mid == XbusMessageId.GOTO_CONFIG
        took_s = 1.5 if message.mid == XbusMessageId.GOTO_CONFIG else 0.0
        self.free_s = max(self.free_s, loop.time()) + took_s
        loop.call_at(self.free_s, super()._answer, message)


@pytest.mark.alone
async def test_a_device_that_acknowledges_after_a_second_and_a_half_comes_up(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    async def comes_up(folder: Path, *, streams: bool) -> None:
        device = Queueing(folder / "imu", options=XbusDeviceOptions(measures_at_once=streams))
        async with serving(device, feeding=True):
            assert len(await chunks_of(make(folder))) >= 5
            assert device.asked == 1 or not streams, "a streaming device gets one request"

    # Both cases wait for seconds, so they run concurrently.
    await asyncio.gather(
        comes_up(tmp_path_factory.mktemp("streaming"), streams=True),
        comes_up(tmp_path_factory.mktemp("silent"), streams=False),
    )


async def test_device_that_restarts_at_every_request_is_configured(tmp_path: Path) -> None:
    options = XbusDeviceOptions(measures_at_once=True, config_delay_s=1.5)
    async with serving(XbusDevice(tmp_path / "imu", options=options), feeding=True):
        assert len(await chunks_of(make(tmp_path))) >= 5


async def test_a_late_answer_of_a_port_without_a_speed_is_no_other_speed(tmp_path: Path) -> None:
    """The answer arrives while the driver tries another speed, but the speed is not the cause."""

    class Late(XbusDevice):  # a device on USB, which answers at any configured speed
        awake_s: float | None = None

        @override
        def _answer(self, message: XbusMessage) -> None:
            loop = asyncio.get_running_loop()
            if self.awake_s is None:
                self.awake_s = loop.time() + 3.6  # after the last attempt at this speed
            loop.call_at(self.awake_s, super()._answer, message)

    device = Late(tmp_path / "imu")
    async with serving(device):
        assert "too late" in await refusal(make(tmp_path), DeviceLostError)


async def test_a_slow_device_of_another_kind_is_no_noise(tmp_path: Path) -> None:
    line = PtyLine(tmp_path / "imu")

    async def send() -> None:
        while True:
            line.write(b"\x55\x53\x01\x02\x03")
            await asyncio.sleep(0.5)

    tasks = [asyncio.create_task(line.serve(lambda _: None)), asyncio.create_task(send())]
    assert "is not Xbus" in await refusal(make(tmp_path), DeviceMisconfiguredError)
    for task in tasks:
        task.cancel()
    await asyncio.wait(tasks)
    line.unplug()


async def test_noise_before_silence_is_reported_without_figures(tmp_path: Path) -> None:
    line, asked = PtyLine(tmp_path / "imu"), asyncio.Event()
    serving_line = asyncio.create_task(line.serve(lambda _: asked.set()))
    running = asyncio.create_task(make(tmp_path).run(lambda _: None))
    await asked.wait()  # bytes that arrive before the port is open are discarded
    line.write(b"\x01\x02\x03")
    with pytest.raises(DeviceLostError) as caught:
        await running
    # A number would differ at every attempt, and every new text would add a line to the log.
    assert str(caught.value) == (
        f"{tmp_path}/imu: some bytes of noise, then silence: check its power and cable, and `port`"
    )
    serving_line.cancel()
    await asyncio.wait([serving_line])
    line.unplug()


async def test_a_silent_port_may_work_later(tmp_path: Path) -> None:
    line = PtyLine(tmp_path / "imu")
    driver = make(tmp_path)
    assert "silent" in await refusal(driver, DeviceLostError)
    loop = asyncio.get_running_loop()
    began = loop.time()
    assert "silent" in await refusal(driver, DeviceLostError)
    assert loop.time() - began < 2.0  # the second attempt does not try every speed
    line.unplug()


async def test_a_stuck_device_is_reset_only_with_permission(tmp_path: Path) -> None:
    device = XbusDevice(tmp_path / "imu", options=XbusDeviceOptions(stuck=True))
    async with serving(device, feeding=True):
        said = await refusal(make(tmp_path), DeviceLostError)
        assert "reset_if_stuck" in said
        chunks = await chunks_of(make(tmp_path, reset_if_stuck=True))
    assert XbusMessageId.MT_DATA2 in mids(chunks)


async def test_a_device_that_just_woke_up_is_configured_at_once(tmp_path: Path) -> None:
    device = XbusDevice(tmp_path / "imu", options=XbusDeviceOptions(wakes_up=True))
    async with serving(device, feeding=True):
        chunks = await chunks_of(make(tmp_path))
    assert mids(chunks)[0] == XbusMessageId.GOTO_CONFIG_ACK


async def test_a_power_failure_while_streaming_is_one_restart(tmp_path: Path) -> None:
    device, driver = XbusDevice(tmp_path / "imu"), make(tmp_path, silence_s=1.0)
    decoder, events = driver.decoder(), []
    async with serving(device, feeding=True):
        task = asyncio.create_task(driver.run(lambda chunk: events.extend(decoder.feed(chunk))))
        while device.sent < 10:
            await asyncio.sleep(0.01)
        device.power_cycle()
        while device.sent < 20:
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.05)
        task.cancel()
        await asyncio.wait({task})
    kinds = [event.kind for event in events if isinstance(event, DeviceEvent)]
    assert kinds.count("restart") == 1
    assert kinds.count("gap") == 0
    assert sum(isinstance(event, ImuSample) for event in events) >= 20


async def test_the_acknowledgement_is_found_behind_a_broken_message(tmp_path: Path) -> None:
    def cut_off(data: bytes) -> bytes:
        return (
            b"\xfa\xff\x36\xff\x07\xd0" + data if data[2] == XbusMessageId.GOTO_CONFIG_ACK else data
        )

    device = XbusDevice(tmp_path / "imu", wire_noise=cut_off)
    async with serving(device, feeding=True):
        chunks = await chunks_of(make(tmp_path))
    assert mids(chunks)[0] == XbusMessageId.GOTO_CONFIG_ACK


async def test_more_than_the_line_carries_is_refused_before_anything_is_sent(
    tmp_path: Path,
) -> None:
    device = XbusDevice(tmp_path / "imu")
    async with serving(device):
        said = await refusal(make(tmp_path, rate_hz=400), DeviceMisconfiguredError)
    assert "144000 bit/s" in said


@pytest.mark.parametrize("rate_hz", [0.5, 99.5, 800])
def test_a_rate_that_is_no_whole_number_up_to_400_is_refused(
    tmp_path: Path, rate_hz: float
) -> None:
    with pytest.raises(ValidationError):
        make(tmp_path, rate_hz=rate_hz)


@pytest.mark.parametrize("precision", Precision)
def test_any_precision_world_and_additional_output_is_accepted(precision: Precision) -> None:
    outputs = (
        setup.Output(Item.PACKET_COUNTER, 0xFFFF),
        setup.Output(Item.SAMPLE_TIME_FINE, 0xFFFF),
        setup.Output(real_id(Item.QUATERNION, precision, "NWU"), 100),
        setup.Output(real_id(Item.ACCELERATION), 100),
    )
    assert output_differences(outputs, 100) == []
