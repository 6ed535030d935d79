"""The decoder of LPMS sensors on serial lines: test vectors, time, and faults of the stream."""

from __future__ import annotations

import json
import math
import struct
from itertools import pairwise
from random import Random
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample
from jointfit_daemon.tools.discovery import decode_stream
from jointfit_drivers.lpms import LpmsDecoder, LpmsImu, LpmsSettings
from jointfit_drivers.lpms._tick_rate import TickRateCheck
from jointfit_protocols.lpms import encode
from jointfit_protocols.lpms.configuration import (
    GENERATION_1,
    TABLES,
    LpmsCommand,
    LpmsConfiguration,
    encode_configuration,
    encode_firmware,
)
from jointfit_protocols.lpms.measurement import PacketLayout, tick_of
from jointfit_protocols.orientation import native_of
from jointfit_simulators._contract_fixtures import orientation

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.model import Decoded

PERIOD_NS = 10_000_000


def decoder(generation: int = 3, **more: Any) -> LpmsDecoder:
    table = {"id": "S1", "segment": "thigh", "driver": "lpms", "port": "/dev/null"} | more
    return LpmsImu(LpmsSettings.model_validate({"generation": generation, **table})).decoder()


def packet(
    number: int, tick: int | None = None, *, unit: int | None = None, generation: int = 3
) -> bytes:
    table = TABLES[generation]
    w, x, y, z = native_of(orientation(number), "NWU")
    values = [part * (unit or 1) for part in (w, -x, -y, -z)]
    tick = 5 * number if tick is None else tick
    layout = PacketLayout(table, table.quaternion)
    return encode(LpmsCommand.DATA, layout.encode(tick, values, floats=unit is None))


def fed(under_test: LpmsDecoder, wires: list[bytes], period_ns: int = PERIOD_NS) -> list[Decoded]:
    return [
        event
        for number, wire in enumerate(wires, 1)
        for event in under_test.feed(Chunk(number * period_ns, wire))
    ]


def samples(events: list[Decoded]) -> list[ImuSample]:
    return [event for event in events if isinstance(event, ImuSample)]


def texts(events: list[Decoded], kind: str) -> list[str]:
    return [e.text for e in events if isinstance(e, DeviceEvent) and e.kind == kind]


def test_vectors_give_the_canonical_orientation(shared_data: Path) -> None:
    known = json.loads((shared_data / "imu" / "vectors.json").read_text())
    measured = [
        v for v in known if v["protocol"] == "lpms-lpbus" and "tick" in v.get("decoded", {})
    ]
    assert len(measured) == 5
    for vector in measured:
        config = vector.get("config")
        under_test, wires = decoder(1), []
        if config is not None:  # the mask is read before the stream begins
            setting = LpmsConfiguration(int(config["transmit"], 16), 100, floats=True)
            wires = [encode(0x04, encode_configuration(GENERATION_1, 0x04, setting))]
        (sample,) = samples(fed(under_test, [*wires, bytes.fromhex(vector["hex"])]))
        wanted = vector["decoded"]["canonical_wxyz"]
        sign = (
            1 if sum(a * b for a, b in zip(sample.q_world_sensor, wanted, strict=True)) > 0 else -1
        )
        assert [sign * part for part in sample.q_world_sensor] == pytest.approx(wanted, abs=2e-8)
        assert list(sample.q_native) == pytest.approx(vector["decoded"]["native_wxyz"], abs=1e-12)
        assert sample.ticks == vector["decoded"]["tick"]


@given(st.lists(st.integers(1, 60), max_size=20), st.sampled_from([None, 10_000, 1_000, 32_767]))
def test_no_split_changes_the_samples(pieces: list[int], unit: int | None) -> None:
    wire = b"".join(packet(n, unit=unit) for n in range(8))
    whole = samples(fed(decoder(), [wire]))
    assert len(whole) == 8
    under_test, at, found = decoder(), 0, []
    for size in [*pieces, len(wire)]:
        found += under_test.feed(Chunk(PERIOD_NS, wire[at : at + size]))
        at += size
    assert [s._replace(arrival_ns=0) for s in samples(found)] == [
        s._replace(arrival_ns=0) for s in whole
    ]


def test_stamps_are_back_dated_by_the_bytes_of_the_line() -> None:
    wire = packet(0) + packet(1)
    usb, line = decoder(transport="usb"), decoder(baud=115_200)
    assert [s.arrival_ns for s in samples(fed(usb, [wire]))] == [PERIOD_NS] * 2
    byte_ns = 1e10 / 115_200
    assert [s.arrival_ns for s in samples(fed(line, [wire]))] == [
        PERIOD_NS - round(62 * byte_ns), PERIOD_NS - round(31 * byte_ns),
    ]  # fmt: skip


def test_lost_packets_are_a_gap_and_a_wrap_is_none() -> None:
    ticks = [2**32 - 50 + 5 * n for n in range(30) if n not in {12, 13}]
    found = fed(decoder(), [packet(n, tick % 2**32) for n, tick in enumerate(ticks)])
    assert len(samples(found)) == 28
    assert texts(found, "gap") == ["2 messages lost"]
    assert not texts(found, "restart")


def test_a_restart_of_the_device_is_reported_once_and_loses_nothing() -> None:
    wires = [packet(n, 90_000 + 5 * n) for n in range(30)] + [packet(n, 5 * n) for n in range(30)]
    found = fed(decoder(), wires)
    assert len(samples(found)) == 60
    assert texts(found, "restart") == ["device clock restarted at 0 ticks"]


def test_a_corrupt_time_that_passes_the_sum_is_dropped() -> None:
    wires = [packet(n) for n in range(40)]
    wires[20] = packet(20, 5 * 20 + 2**20)
    found = fed(decoder(), wires)
    assert len(samples(found)) == 39
    assert not texts(found, "restart")
    assert [e.reason for e in found if isinstance(e, Corrupt)] == [
        "device time disagrees with the other messages"
    ]


def test_the_unit_of_integers_is_reported_once() -> None:
    found = fed(decoder(), [packet(n, unit=1_000) for n in range(50)])
    assert len(samples(found)) == 50
    assert texts(found, "info") == ["16-bit quaternions in units of 1/1000"]


def test_a_configured_unit_that_is_wrong_is_reported_with_the_norm() -> None:
    found = fed(decoder(scale=10_000), [packet(n, unit=1_000) for n in range(100)])
    assert not samples(found)
    (text,) = texts(found, "warning")
    assert text.startswith("median quaternion norm is 0.1, expected 1: remove `scale`")


@pytest.mark.parametrize(
    ("ticks_per_s", "configured", "text"),
    [
        (800, None, "expected 500: set tick_hz = 800"),
        (400, None, "expected 500: set tick_hz = 400"),
        (330, None, "set `tick_hz`, and check `rate_hz`"),
        (500, None, None),
        (800, 800, None),
    ],
)
def test_another_tick_rate_is_reported_with_the_setting(
    ticks_per_s: int, configured: int | None, text: str | None
) -> None:
    wires = [packet(n, round(n * ticks_per_s / 100)) for n in range(700)]
    found = fed(decoder(tick_hz=configured), wires)
    assert len(samples(found)) == 700
    warnings = texts(found, "warning")
    assert (text is None) == (not warnings)
    assert all(text in warning for warning in warnings if text)


def seconds(start_s: float) -> list[bytes]:
    return [packet(n, tick_of(start_s + n / 100), generation=1) for n in range(700)]


def test_float_seconds_are_recognized_by_the_firmware() -> None:
    reply = encode(0x2F, encode_firmware(GENERATION_1, "1.3.4"))
    under_test = decoder(1)
    found = fed(under_test, [reply, *seconds(20.0)])
    steps = [b.ticks - a.ticks for a, b in pairwise(samples(found)) if a.ticks and b.ticks]
    assert len(samples(found)) == 700
    assert all(abs(step - 10_000) <= 4 for step in steps)  # microseconds
    assert under_test.tick_clock.tick_ns == 1_000
    assert not texts(found, "warning")


def test_float_seconds_that_nothing_announces_are_reported() -> None:
    found = fed(decoder(1), seconds(20.0))
    assert texts(found, "warning") == [
        'device time is float seconds, not ticks: set device_time = "seconds"'
    ]
    assert len(samples(fed(decoder(1, device_time="seconds"), seconds(20.0)))) == 700
    back = fed(decoder(1, device_time="seconds"), [packet(n, 4 * n) for n in range(700)])
    assert texts(back, "warning") == ['device time is not float seconds: set device_time = "ticks"']


ORDERS = {  # numbers of values of each output before and after the quaternion, from the vendor
    1: ((3, 3, 3, 3), (3, 3, 1, 1, 1, 1)),
    3: ((3,) * 11, (3, 3, 1, 1, 1)),
}


@pytest.mark.parametrize("generation", [1, 3])
@pytest.mark.parametrize(("code", "unit"), [("f", 1), ("h", 10_000), ("h", 1_000)])
def test_the_quaternion_is_found_without_a_reply_that_names_the_outputs(
    generation: int, code: str, unit: int
) -> None:
    rng = Random(generation)
    for _ in range(20):
        before, behind = (
            sum(rng.sample(sizes, rng.randint(0, len(sizes)))) for sizes in ORDERS[generation]
        )
        if (before, behind) == (0, 0):
            continue
        wires, wanted = [], []
        for number in range(17):
            w, x, y, z = native_of(orientation(number), "NWU")
            q = (w, -x, -y, -z)
            rest = [rng.uniform(-3, 3) for _ in range(before + behind)]
            values = [unit * value for value in (*rest[:before], *q, *rest[before:])]
            numbers = values if code == "f" else map(round, values)
            data = struct.pack(f"<I{before + 4 + behind}{code}", 5 * number, *numbers)
            wires.append(encode(LpmsCommand.DATA, data))
            wanted.append(q)
        under_test = decoder(generation)
        found = fed(under_test, wires)
        for sample, q in zip(samples(found), wanted, strict=True):
            assert sample.q_native == pytest.approx(q, abs=1.0 / unit if unit > 1 else 1e-6)
        (text,) = (one for one in texts(found, "info") if "used as the quaternion" in one)
        assert f"values {before + 1} to {before + 4} of {before + 4 + behind}" in text
        assert not texts(found, "warning")


def test_an_acceleration_at_rest_is_no_quaternion() -> None:
    """A rate of 0 and gravity in g together have norm 1, like a quaternion."""
    rng, wires = Random(1), []
    for number in range(20):
        force = [rng.gauss(mean, 0.002) for mean in (0.6, 0.0, 0.8)]
        rate = [rng.gauss(0.0, 0.002) for _ in range(3)]
        values = (*rate, *force, 20.0, 1.0, -40.0, 0.5, 0.5, -0.5, 0.5)
        wires.append(encode(LpmsCommand.DATA, struct.pack("<I13f", 5 * number, *values)))
    found = fed(decoder(1), wires)
    assert [one.q_native for one in samples(found)] == [(0.5, 0.5, -0.5, 0.5)] * 20


def test_packets_before_a_reply_with_the_outputs_are_decoded_with_it() -> None:
    """Packets are stored until a reply names the outputs, and then decoded."""
    values = struct.pack("<I7f", 5, 0.1, 0.2, 0.3, 0.5, 0.5, 0.5, -0.5)
    mask = (1 << 18 | 1 << 16).to_bytes(4, "little")  # angular velocity and quaternion
    wires = [encode(LpmsCommand.DATA, values), encode(0x04, mask)]
    (sample,) = samples(fed(decoder(1), wires))
    assert sample.q_native == (0.5, 0.5, 0.5, -0.5)
    short = decoder(1)
    assert not samples(fed(short, wires[:1]))
    assert [one.q_native for one in samples(short.flush())] == [(0.5, 0.5, 0.5, -0.5)]


@pytest.mark.parametrize(("ratio", "reported"), [(1, False), (3, True), (30, False)])
def test_the_stamps_of_a_file_of_raw_bytes_do_not_contradict_the_device_time(
    ratio: int, reported: bool
) -> None:
    """Device time 3 times as fast as the arrivals is reported, but not 30 times: this is a file."""
    check = TickRateCheck(500, is_seconds=False)
    found = [check.feed(500 * ratio * second, second * 10**9) for second in range(10)]
    assert any(found) == reported


def test_packets_of_another_length_are_reported_once_with_both_lengths() -> None:
    wire = encode(LpmsCommand.DATA, bytes(36))
    under_test = decoder()
    found = fed(under_test, [wire] * 10)
    (text,) = texts(found, "warning")
    assert text.startswith("data packets have 36 bytes, expected 20 (32 bit) or 12 (16 bit)")
    assert (under_test.messages, under_test.discarded_bytes) == (10, 0)


def test_outputs_that_the_sensor_names_are_skipped() -> None:
    mask = GENERATION_1.mask("angular_velocity", "quaternion", "euler", "temperature")
    setting = LpmsConfiguration(mask, 100, floats=True)
    reply = encode(0x04, encode_configuration(GENERATION_1, 0x04, setting))
    layout = PacketLayout(GENERATION_1, mask)
    values = [0.0] * layout.values
    values[layout.places["quaternion"]] = [1.0, 0.0, 0.0, 0.0]
    wire = encode(LpmsCommand.DATA, layout.encode(0, values, floats=True))
    (sample,) = samples(fed(decoder(1), [reply, wire]))
    assert sample.q_native == (1.0, 0.0, 0.0, 0.0)


def test_text_and_another_address_are_reported_once() -> None:
    found = fed(decoder(), [b"100,0.5,0.5,0.5,0.5\r\n"] * 40)
    (text,) = texts(found, "warning")
    assert text.startswith("the sensor sends text: set its output format to LP-BUS")
    found = fed(decoder(), [encode(9, packet(0)[7:-4], 5)] * 3)
    assert texts(found, "warning") == ["the sensor has sensor id 5, expected 1: set `sensor_id`"]
    assert len(samples(found)) == 3


def test_the_norm_of_a_sound_stream_is_published() -> None:
    found = fed(decoder(), [packet(n) for n in range(120)])
    assert texts(found, "info") == ["norm of the first 100 quaternions: 1.00000 to 1.00000"]


def test_the_norm_of_a_stream_without_numbers_is_not_published() -> None:
    layout = PacketLayout(TABLES[3], TABLES[3].quaternion)
    packets = [layout.encode(5 * n, [math.nan] * 4, floats=True) for n in range(120)]
    found = fed(decoder(), [encode(LpmsCommand.DATA, data) for data in packets])
    (warning,) = (e for e in found if isinstance(e, DeviceEvent) and e.kind == "warning")
    assert warning.text.startswith("median quaternion norm is nan, expected 1: ")
    assert warning.data == {}


@given(st.lists(st.binary(max_size=60).map(lambda data: encode(9, data)) | st.binary(), max_size=9))
def test_any_messages_are_decoded_or_counted(wires: list[bytes]) -> None:
    under_test = decoder(1)
    found = fed(under_test, wires) + under_test.flush()
    lost = sum(event.discarded for event in found if isinstance(event, Corrupt))
    assert lost == under_test.discarded_bytes <= sum(map(len, wires))


@pytest.mark.parametrize("outputs", [("quaternion",), ("accelerometer", "quaternion", "euler")])
def test_a_stream_is_recognized_with_any_outputs(outputs: tuple[str, ...]) -> None:
    layout = PacketLayout(TABLES[3], TABLES[3].mask(*outputs))
    values = [0.0] * layout.values
    values[layout.places["quaternion"]] = [1.0, 0.0, 0.0, 0.0]
    chunks = [
        Chunk(n * PERIOD_NS, encode(9, layout.encode(5 * n, values, floats=True)))
        for n in range(1, 40)
    ]
    found = decode_stream(chunks, 115_200)
    assert [device.driver for device in found] == ["lpms"]
    assert (found[0].samples > 0) == (len(outputs) == 1)
    assert bool(found[0].warnings) == (len(outputs) > 1)
