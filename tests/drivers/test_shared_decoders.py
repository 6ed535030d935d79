"""Parts that decoders share: checks of samples, and bases of serial and CAN decoders."""

from __future__ import annotations

import asyncio
import math
import re
from typing import TYPE_CHECKING, NamedTuple, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st
from typing_extensions import override

from jointfit_daemon.driver import DeviceLostError, DeviceMisconfiguredError
from jointfit_daemon.model import Chunk, Corrupt, Decoded, DeviceEvent, ImuSample, TickClock
from jointfit_drivers.can_decoder import CanDecoder
from jointfit_drivers.checked_samples import CheckedSamples
from jointfit_drivers.serial_conversation import SerialConversation
from jointfit_drivers.serial_decoder import SerialDecoder
from jointfit_drivers.silence import explain_missing_messages
from jointfit_protocols import can
from jointfit_protocols.corrupt import NO_START, CorruptBytes
from jointfit_protocols.resynchronizing_codec import ResynchronizingCodec

if TYPE_CHECKING:
    from jointfit_drivers.ports.serial_port import SerialPort

MS = 1_000_000
CLOCK = TickClock(tick_ns=125_000, modulus=1 << 32)
PERIOD = 80
"""Sample period of 10 ms, in ticks of 125 us."""


def sample(number: int, *, ticks: int | None = None, norm: float = 1.0) -> ImuSample:
    q = (norm * math.cos(0.01 * number), norm * math.sin(0.01 * number), 0.0, 0.0)
    at = number * PERIOD if ticks is None else ticks
    return ImuSample(number * 10 * MS, q, q, at % (1 << 32), number % 256)


def add_all(samples: list[ImuSample]) -> tuple[CheckedSamples, list[Decoded]]:
    checked = CheckedSamples(100.0, CLOCK, counts=256)
    return checked, [item for one in samples for item in checked.add(one, 33)]


def kinds(found: list[Decoded]) -> list[str]:
    return [item.kind for item in found if isinstance(item, DeviceEvent)]


# --- checks of samples ------------------------------------------------------------------------


def test_lost_messages_are_counted_across_the_wrap_of_counter_and_time() -> None:
    start = (1 << 32) - 20 * PERIOD
    numbers = [n for n in range(600) if not 250 <= n < 260]
    _, found = add_all([sample(n, ticks=start + n * PERIOD) for n in numbers])
    assert [item.data for item in found if isinstance(item, DeviceEvent)] == [{"lost": 10}]
    assert sum(isinstance(item, ImuSample) for item in found) == len(numbers)


def test_a_restart_is_reported_before_its_first_sample_and_costs_none() -> None:
    before = [sample(n, ticks=1_000_000 + n * PERIOD) for n in range(50)]
    after = [sample(n)._replace(arrival_ns=(60 + n) * 10 * MS) for n in range(1, 20)]
    _, found = add_all(before + after)
    assert kinds(found) == ["restart"]
    assert isinstance(found[50], DeviceEvent)
    assert sum(isinstance(item, ImuSample) for item in found) == 69


def test_one_corrupt_time_is_refused_and_restarts_nothing() -> None:
    samples = [sample(n) for n in range(60)]
    samples[40] = sample(40, ticks=3_000_000_000)
    checked, found = add_all(samples)
    assert kinds(found) == ["gap"]
    assert (checked.refused, checked.refused_bytes) == (1, 33)


def test_a_wrong_scale_is_reported_once() -> None:
    checked, found = add_all([sample(n, norm=2.0) for n in range(300)])
    (warning,) = (item for item in found if isinstance(item, DeviceEvent))
    assert warning.data["median_norm"] == pytest.approx(2.0)
    assert checked.refused == 300


@pytest.mark.parametrize(("every", "rate_hz"), [(1, None), (2, 50.0)])
def test_another_rate_than_the_configured_one_is_reported_once(
    every: int, rate_hz: float | None
) -> None:
    start = (1 << 32) - 10 * PERIOD
    sent = [sample(n, ticks=start + n * PERIOD * every) for n in range(100) if n != 5]
    _, found = add_all(sent)
    warnings = [item for item in found if isinstance(item, DeviceEvent) and item.kind == "warning"]
    assert [item.data["rate_hz"] for item in warnings] == ([] if rate_hz is None else [rate_hz])
    assert all("set rate_hz = 50" in item.text for item in warnings)


def test_samples_without_time_and_counter_pass() -> None:
    checked = CheckedSamples(100.0, None, None)
    bare = sample(1)._replace(ticks=None, counter=None)
    assert checked.add(bare, 9) == [bare]


# --- serial -----------------------------------------------------------------------------------


class Pair(NamedTuple):
    value: int
    end: int
    size: int = 2


def read(buffer: bytes, at: int, base: int) -> Pair | CorruptBytes | None:
    if buffer[at] != 0xA5:
        return CorruptBytes(1, NO_START)
    return None if len(buffer) < at + 2 else Pair(buffer[at + 1], base + at + 2)


def pair_codec() -> ResynchronizingCodec[Pair]:
    return ResynchronizingCodec(read, re.compile(rb"\xa5"), longest_run=64)


class PairDecoder(SerialDecoder[Pair]):
    def __init__(self) -> None:
        super().__init__(pair_codec(), CheckedSamples(100.0, None, 256), 1000, longest=2)

    @override
    def convert(self, message: Pair, arrival_ns: int) -> list[Decoded]:
        if message.value == 0:
            return [self.samples.refuse(message.size, "zero")]
        q = (1.0, 0.0, 0.0, 0.0)
        return self.samples.add(ImuSample(arrival_ns, q, q, None, message.value), message.size)


@given(st.binary(max_size=60), st.integers(1, 7))
def test_a_serial_decoder_accounts_for_every_byte_in_any_split(data: bytes, size: int) -> None:
    whole, split = PairDecoder(), PairDecoder()
    items = whole.feed(Chunk(0, data)) + whole.flush()
    parts = [data[at : at + size] for at in range(0, len(data), size)]
    again = [item for part in parts for item in split.feed(Chunk(0, part))] + split.flush()
    assert (split.messages, split.discarded_bytes) == (whole.messages, whole.discarded_bytes)
    assert 2 * whole.messages + whole.discarded_bytes == len(data)
    for found in items, again:
        corrupt = sum(item.discarded for item in found if isinstance(item, Corrupt))
        assert corrupt == whole.discarded_bytes


def test_a_serial_decoder_stamps_the_first_byte_and_forgets_a_message_cut_by_silence() -> None:
    decoder = PairDecoder()
    first, second = decoder.feed(Chunk(1000 * MS, b"\xa5\x01\xa5\x02\xa5"))
    assert isinstance(first, ImuSample)
    assert isinstance(second, ImuSample)
    assert (first.arrival_ns, second.arrival_ns) == (950 * MS, 970 * MS)
    late = decoder.feed(Chunk(9000 * MS, b"\xa5\x03"))
    assert isinstance(late[0], Corrupt)
    assert decoder.messages == 3


class FakePort:
    """Port on which a device sends at one speed."""

    path = "/dev/ttyUSB0"

    def __init__(self, sends_at: int | None, baud: int) -> None:
        self._sends_at, self.baud = sends_at, baud

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def flush_input(self) -> None:
        """Nothing is buffered."""

    async def receive(self, timeout_s: float) -> Chunk | None:
        await asyncio.sleep(timeout_s)
        if self._sends_at is None:
            return None
        return Chunk(0, b"\xa5\x01" if self.baud == self._sends_at else b"\x33\x44")


@pytest.mark.parametrize(
    ("sends_at", "error", "text"),
    [
        (None, DeviceLostError, "silent"),
        (57_600, DeviceMisconfiguredError, "the device sends at 57600: set baud = 57600"),
        (9600, DeviceMisconfiguredError, "does not use pairs"),
    ],
)
def test_missing_messages_are_explained_and_none_of_another_speed_is_emitted(
    sends_at: int | None, error: type[Exception], text: str
) -> None:
    emitted: list[Chunk] = []

    async def scene() -> None:
        port = cast("SerialPort", FakePort(sends_at, 115_200))
        conversation = SerialConversation(port, emitted.append, pair_codec)
        assert await conversation.receive(lambda _: True, 0.02) is None
        await explain_missing_messages(
            port, conversation, baud=115_200, speeds=(115_200, 57_600), family="pairs"
        )

    with pytest.raises(error, match=text):
        asyncio.run(scene())
    assert not emitted


def test_a_device_that_sends_other_messages_only_is_not_at_another_speed() -> None:
    async def scene() -> None:
        port = cast("SerialPort", FakePort(115_200, 115_200))
        conversation = SerialConversation(port, lambda _: None, pair_codec)
        assert await conversation.receive(lambda message: message.value == 9, 0.02) is None
        await explain_missing_messages(
            port, conversation, baud=115_200, speeds=(115_200, 57_600), family="pairs"
        )

    with pytest.raises(DeviceLostError, match="no measurements: switch their output on"):
        asyncio.run(scene())


# --- CAN --------------------------------------------------------------------------------------


class OneFrameDecoder(CanDecoder):
    def __init__(self) -> None:
        super().__init__({(0x101, False)}, CheckedSamples(100.0, None, 256))

    @override
    def convert(self, frame: can.CanFrame) -> list[Decoded]:
        if len(frame.data) != 1:
            return [self.samples.refuse(can.RECORD_BYTES, "length")]
        q = (1.0, 0.0, 0.0, 0.0)
        sample = ImuSample(frame.t_ns, q, q, None, frame.data[0])
        return self.samples.add(sample, can.RECORD_BYTES)


def test_a_can_decoder_converts_its_frames_and_reports_errors_of_the_bus() -> None:
    decoder = OneFrameDecoder()
    frames = [
        can.CanFrame(1, 0x101, b"\x01"),
        can.CanFrame(2, 0x101, b"\x02", extended=True),  # of another device
        can.CanFrame(3, 0x102, b"\x02"),
        can.CanFrame(4, 0x101, b"", remote=True),
        can.host_dropped(5, 7),
        can.host_corrupt(6, 11),
        can.CanFrame(7, 0x101, b"\x02\x02"),
        can.CanFrame(8, 0x101, b"\x02"),
    ]
    found = decoder.feed(Chunk(9, can.pack_frames(frames) + b"rest"))
    assert [item.arrival_ns for item in found if isinstance(item, ImuSample)] == [1, 8]
    assert kinds(found) == ["warning"]
    assert (decoder.messages, decoder.discarded_bytes) == (2, 11 + can.RECORD_BYTES + 4)
    corrupt = sum(item.discarded for item in found if isinstance(item, Corrupt))
    assert corrupt == decoder.discarded_bytes
    assert decoder.flush() == []
