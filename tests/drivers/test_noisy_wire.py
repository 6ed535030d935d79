"""Damage on the wire causes no restart, and hardly more reported losses than lost messages."""

from __future__ import annotations

import random
from typing import TYPE_CHECKING, NamedTuple

import pytest

from jointfit_daemon.model import Chunk, DeviceEvent, ImuSample
from jointfit_daemon.timing.clock import DeviceClock
from jointfit_drivers.xbus import XbusDecoder
from jointfit_drivers.xcdi import XcdiDecoder
from jointfit_protocols.can import CanFrame, pack_frames
from jointfit_protocols.can.slcan import SlcanCodec, encode_frame
from jointfit_protocols.xbus import XbusMessageId, encode
from jointfit_protocols.xbus.mtdata2 import Item, encode_items
from jointfit_protocols.xcdi import DataId, XcdiIds, quaternion_counts
from jointfit_protocols.xcdi import encode as xcdi_encode
from jointfit_simulators._contract_fixtures import orientation

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.driver import Decoder

SECONDS = 12
RATE_HZ = 100
PERIOD_NS = 1_000_000_000 // RATE_HZ
MESSAGES = SECONDS * RATE_HZ
SEEDS = range(5)


class NoisyRun(NamedTuple):
    """Numbers of samples, lost samples and restarts of one run."""

    received: int
    lost: int
    restarts: int


def measurement(number: int) -> bytes:
    items = (
        (Item.PACKET_COUNTER, number % 65536),
        (Item.SAMPLE_TIME_FINE, 5_000_000 + 100 * number),
        (Item.STATUS_WORD, 3),
        (Item.QUATERNION, orientation(number)),
    )
    return encode(XbusMessageId.MT_DATA2, encode_items(items))


def outcome(decoder: Decoder, chunks: list[bytes]) -> NoisyRun:
    clock = DeviceClock(PERIOD_NS)
    received = lost = restarts = 0
    for number, data in enumerate(chunks):
        for event in decoder.feed(Chunk((number + 1) * PERIOD_NS, data)):
            if isinstance(event, ImuSample):
                received += 1
                clock.feed_sample(event.ticks, event.counter, event.arrival_ns, decoder.tick_clock)
                restarts += sum(news.kind == "restart" for news in clock.news)
                clock.news.clear()
            elif isinstance(event, DeviceEvent):
                restarts += event.kind == "restart"
                count = event.data.get("lost", 0)
                lost += count if isinstance(count, int) else 0
    return NoisyRun(received, lost, restarts)


def with_flipped_bits(chance: random.Random, data: bytes) -> bytes:
    """Return `data` with one bit flipped in a tenth of its bytes."""
    return bytes(
        byte ^ (1 << chance.randrange(8)) if chance.random() < 0.1 else byte for byte in data
    )


def with_damage_that_passes(chance: random.Random, number: int) -> bytes:
    """Return a message that is damaged in 10 % of the cases, of which 10 % pass the checksum."""
    data = bytearray(measurement(number))
    if chance.random() < 0.1:
        data[chance.randrange(4, len(data) - 1)] ^= 1 << chance.randrange(8)
        if chance.random() < 0.1:
            data[-1] = -sum(data[1:-1]) % 256
    return bytes(data)


def wires(damage: Callable[[random.Random, int], bytes], seed: int) -> list[bytes]:
    chance = random.Random(seed)
    return [damage(chance, number) for number in range(MESSAGES)]


def lines(chance: random.Random, number: int, share: float) -> bytes:
    """Return a group of a sensor on an SLCAN adapter, whose line has no checksum.

    One digit is changed in `share` of the lines.
    """
    values = (
        (DataId.SAMPLE_TIME, (500_000 + 100 * number,)),
        (DataId.GROUP_COUNTER, (number % 65536,)),
        (DataId.QUATERNION, quaternion_counts(orientation(number))),
    )
    group = b""
    for data_id, counts in values:
        line = bytearray(encode_frame(CanFrame(0, int(data_id), xcdi_encode(data_id, counts))))
        if chance.random() < share:
            line[chance.randrange(1, len(line) - 1)] = ord(chance.choice("0123456789ABCDEF"))
        group += line
    return group


def xcdi_outcome(seed: int, share: float) -> NoisyRun:
    slcan, chance = SlcanCodec(None), random.Random(seed)
    chunks = []
    for number in range(MESSAGES):
        t_ns = (number + 1) * PERIOD_NS
        found = slcan.feed(lines(chance, number, share), t_ns)
        chunks.append(pack_frames(item for item in found if isinstance(item, CanFrame)))
    return outcome(XcdiDecoder(XcdiIds(), "100us", "big", 100.0), chunks)


@pytest.mark.parametrize("share", [0.01, 0.1])
@pytest.mark.parametrize("seed", SEEDS)
def test_a_line_without_checksum_makes_no_restart_and_few_losses(seed: int, share: float) -> None:
    found = xcdi_outcome(seed, share)
    assert found.restarts == 0, found
    assert found.lost <= 1.5 * (MESSAGES - found.received) + 5, found
    assert found.received > (1 - 4 * share) * MESSAGES, found


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(
    "damage",
    [
        lambda chance, number: with_flipped_bits(chance, measurement(number)),
        with_damage_that_passes,
    ],
    ids=["a tenth of all bytes", "a tenth of all messages"],
)
def test_xbus_reports_no_more_lost_than_were_sent_and_no_restart(
    damage: Callable[[random.Random, int], bytes], seed: int
) -> None:
    found = outcome(XbusDecoder(None, RATE_HZ), wires(damage, seed))
    assert found.restarts == 0, found
    assert found.received + found.lost <= MESSAGES, found
    assert found.lost <= MESSAGES - found.received, found
