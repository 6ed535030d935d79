"""Decoders and the clock behind them process any bytes, without an error and in bounded time."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

from hypothesis import given, settings
from hypothesis import strategies as st

from jointfit_daemon.model import Chunk, ImuSample, TickClock
from jointfit_daemon.timing.clock import DeviceClock
from jointfit_drivers.gateway_orientation import RawSamples
from jointfit_drivers.xbus import XbusDecoder
from jointfit_drivers.xbus._raw_orientation import RawOrientation
from jointfit_drivers.xcdi import XcdiDecoder
from jointfit_protocols.can import CanFrame, pack_frames
from jointfit_protocols.can.slcan import SlcanCodec
from jointfit_protocols.xbus import XbusMessageId, encode
from jointfit_protocols.xbus.mtdata2 import Item, encode_items
from jointfit_protocols.xcdi import XcdiIds

if TYPE_CHECKING:
    from jointfit_daemon.driver import Decoder

U16, U32 = st.integers(0, 2**16 - 1), st.integers(0, 2**32 - 1)
SMALL_STEPS = st.integers(0, 300)
FLOATS = st.floats(width=32)
PERIOD_NS = 10_000_000
MOST_MESSAGES = 60


def through_clock(decoder: Decoder, chunks: list[Chunk]) -> None:
    """Feed the samples of `chunks` to a clock, as the core does."""
    clock = DeviceClock(PERIOD_NS)
    for chunk in chunks:
        for event in decoder.feed(chunk):
            if isinstance(event, ImuSample):
                clock.feed_sample(event.ticks, event.counter, event.arrival_ns, decoder.tick_clock)
        assert clock.skew_ppm is None or abs(clock.skew_ppm) < 1e7
    decoder.flush()


@st.composite
def xbus_messages(draw: st.DrawFn) -> bytes:
    """Return a message with any values, including runs of equal values."""
    items: list[tuple[int, Any]] = []
    if draw(st.booleans()):
        items.append((Item.PACKET_COUNTER, draw(SMALL_STEPS | U16)))
    if draw(st.booleans()):
        items.append((Item.SAMPLE_TIME_FINE, draw(SMALL_STEPS | U32)))
    unit = st.sampled_from([(1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)])
    items.append((Item.QUATERNION, draw(unit | st.tuples(FLOATS, FLOATS, FLOATS, FLOATS))))
    if draw(st.booleans()):
        items.append((Item.RATE_OF_TURN, draw(st.tuples(FLOATS, FLOATS, FLOATS))))
        items.append((Item.ACCELERATION, draw(st.tuples(FLOATS, FLOATS, FLOATS))))
    return encode(XbusMessageId.MT_DATA2, encode_items(items)) * draw(st.sampled_from([1, 1, 15]))


arrivals = st.lists(st.integers(0, 10**10), min_size=MOST_MESSAGES, max_size=MOST_MESSAGES)


def stamped(wires: list[bytes], steps: list[int]) -> list[Chunk]:
    t_ns, chunks = 0, []
    for data, step in zip(wires, steps, strict=False):
        t_ns += step
        chunks.append(Chunk(t_ns, data))
    return chunks


@given(st.lists(xbus_messages() | st.binary(max_size=80), max_size=MOST_MESSAGES), arrivals)
def test_xbus(wires: list[bytes], steps: list[int]) -> None:
    through_clock(XbusDecoder(115_200, 100.0), stamped(wires, steps))


@given(st.lists(xbus_messages(), max_size=MOST_MESSAGES), arrivals)
def test_xbus_with_raw_readings(wires: list[bytes], steps: list[int]) -> None:
    raw = RawOrientation(partial(RawSamples, 100.0, magnetometer=False))
    through_clock(XbusDecoder(None, 100.0, None, raw), stamped(wires, steps))


frames = st.builds(
    CanFrame,
    t_ns=st.integers(-(2**62), 2**62),
    can_id=st.sampled_from([0x01, 0x05, 0x06, 0x11, 0x21]),
    data=st.binary(max_size=8) | SMALL_STEPS.map(lambda value: value.to_bytes(4, "big")),
)


@given(st.lists(frames, max_size=3 * MOST_MESSAGES))
def test_xcdi(wire: list[CanFrame]) -> None:
    chunks = [Chunk(frame.t_ns, pack_frames([frame])) for frame in wire]
    through_clock(XcdiDecoder(XcdiIds(), "auto", "big", 100.0), chunks)


@given(st.lists(st.binary(max_size=60) | st.from_regex(rb"[tTrR][0-9A-F]{1,27}\r"), max_size=60))
def test_slcan(wires: list[bytes]) -> None:
    decoder, xcdi = SlcanCodec(115_200), XcdiDecoder(XcdiIds(), "auto", "big", 100.0)
    for number, data in enumerate(wires):
        found = decoder.feed(data, number * PERIOD_NS)
        xcdi.feed(Chunk(0, pack_frames(item for item in found if isinstance(item, CanFrame))))
    decoder.flush()


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(
            st.none() | SMALL_STEPS | U32,
            st.none() | SMALL_STEPS | U32,
            st.integers(0, 10**10),
        ),
        max_size=200,
    ),
    st.sampled_from(
        [None, TickClock(100_000, 2**32), TickClock(1_000, 2**32), TickClock(100_000, None)]
    ),
)
def test_clock(samples: list[tuple[int | None, int | None, int]], ticks: TickClock | None) -> None:
    clock, t_ns = DeviceClock(PERIOD_NS), 0
    for tick, counter, step in samples:
        t_ns += step
        clock.feed_sample(tick, counter, t_ns, ticks)
