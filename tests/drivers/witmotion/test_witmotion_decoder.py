"""The WitMotion decoder: stamps, time, raw readings, and reports about unsuitable streams."""

from __future__ import annotations

from math import atan2
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample
from jointfit_drivers.witmotion import WitMotionDecoder, WitMotionImu, WitMotionSettings
from jointfit_protocols.witmotion import WitMotionFrameKind as Kind
from jointfit_protocols.witmotion import encode, encode_counts, encode_time

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded

PERIOD_NS = 10_000_000
FRAME_NS = 11 * 10 * 1_000_000_000 // 115_200
BEGIN_MS = 826_000_000_000


def decoder(**more: Any) -> WitMotionDecoder:
    table: dict[str, Any] = {"id": "S1", "segment": "thigh", "driver": "witmotion", "port": "p"}
    return WitMotionImu(WitMotionSettings(**table | more)).decoder()


def quaternion(w: int = 16384, x: int = -16384, y: int = 3277, z: int = 22938) -> bytes:
    return encode(Kind.QUATERNION, encode_counts((w, x, y, z)))


def time(ms: int) -> bytes:
    return encode(Kind.TIME, encode_time(BEGIN_MS + ms))


def run(wit: WitMotionDecoder, pieces: list[bytes]) -> list[Decoded]:
    return [
        event for k, data in enumerate(pieces, 1) for event in wit.feed(Chunk(k * PERIOD_NS, data))
    ]


def samples(events: list[Decoded]) -> list[ImuSample]:
    return [event for event in events if isinstance(event, ImuSample)]


def test_a_sample_is_stamped_with_its_first_byte() -> None:
    early, late = samples(decoder().feed(Chunk(PERIOD_NS, quaternion() * 2)))
    assert early.arrival_ns == pytest.approx(PERIOD_NS - 2 * FRAME_NS, abs=1000)
    assert late.arrival_ns == pytest.approx(PERIOD_NS - FRAME_NS, abs=1000)
    (timed,) = samples(decoder(device_time=True).feed(Chunk(PERIOD_NS, time(0) + quaternion())))
    assert timed.arrival_ns == early.arrival_ns


@pytest.mark.parametrize(
    ("world", "direction", "expected"),
    [
        ("ENU", "sensor_to_world", (0.5, -0.5, 0.1, 0.7)),
        ("NED", "sensor_to_world", (0.28284, 0.84853, -0.14142, 0.42426)),
        ("NWU", "sensor_to_world", (-0.14142, -0.42426, -0.28284, 0.84853)),
        ("NWU", "world_to_sensor", (0.84853, 0.42426, 0.28284, -0.14142)),
    ],
)
def test_world_and_direction_are_settings(world: str, direction: str, expected: Any) -> None:
    wit = decoder(world=world, direction=direction)
    (sample,) = samples(wit.feed(Chunk(0, quaternion())))
    sign = 1.0 if sample.q_world_sensor[0] * expected[0] > 0 else -1.0
    assert sample.q_world_sensor == pytest.approx([sign * part for part in expected], abs=1e-4)


def test_time_is_used_on_request_only_and_belongs_to_one_quaternion() -> None:
    wire = [time(0) + quaternion(), quaternion(), time(20) + quaternion()]
    assert [item.ticks for item in samples(run(decoder(), wire))] == [None] * 3
    wit = decoder(device_time=True)
    ticks = [item.ticks for item in samples(run(wit, wire))]
    assert ticks == [BEGIN_MS, None, BEGIN_MS + 20]
    assert wit.tick_clock is not None
    assert (wit.tick_clock.tick_ns, wit.tick_clock.modulus) == (1_000_000, None)


def test_a_glitch_of_the_time_is_dropped_and_a_clock_that_was_set_is_used_again() -> None:
    times = [0, 10, 3_600_020, 30, 40, *range(500_000, 500_100, 10)]
    found = samples(run(decoder(device_time=True), [time(ms) + quaternion() for ms in times]))
    ticks = [None if item.ticks is None else item.ticks - BEGIN_MS for item in found]
    assert ticks[:5] == [0, 10, None, 30, 40]
    assert ticks[5:8] == [None] * 3
    assert ticks[8:] == times[8:]


def test_a_norm_that_is_not_1_is_rejected_and_reported_once() -> None:
    wit = decoder()
    events = run(wit, [quaternion(8192, 0, 0, 0)] * 120)
    assert not samples(events)
    assert wit.discarded_bytes == 120 * 11
    (warning,) = [item for item in events if isinstance(item, DeviceEvent)]
    assert "median quaternion norm is 0.25" in warning.text


def test_a_stream_without_quaternions_is_reported_once() -> None:
    wire = encode(Kind.ACCELERATION, bytes(8)) + encode(Kind.ANGLE, bytes(8))
    (warning,) = run(decoder(), [wire] * 200)
    assert isinstance(warning, DeviceEvent)
    assert "it sends acceleration, angle, but no quaternion" in warning.text


def test_a_file_in_one_piece_is_no_stream_without_quaternions() -> None:
    wire = (encode(Kind.ACCELERATION, bytes(8)) + quaternion()) * 100
    assert {type(event) for event in decoder().feed(Chunk(0, wire))} == {ImuSample}


def test_the_bluetooth_variant_is_reported() -> None:
    events = run(decoder(), [b"\x55\x61" + bytes(18)] * 30)
    errors = [item for item in events if isinstance(item, DeviceEvent)]
    assert len(errors) == 1
    assert "55 61" in errors[0].text
    assert not samples(events)


def test_silence_ends_an_incomplete_frame() -> None:
    wit = decoder()
    assert wit.feed(Chunk(0, quaternion()[:5])) == []
    cut, sample = wit.feed(Chunk(300_000_000, quaternion()))
    assert cut == Corrupt(5, "cut off")
    assert isinstance(sample, ImuSample)


# --- raw readings -----------------------------------------------------------------------------


def raw_frames(ms: int, rate_z: float, *, field: bool = False) -> bytes:
    rate = round(rate_z / 34.906585 * 32768)
    data = time(ms) + encode(Kind.ACCELERATION, encode_counts((0, 0, 2048, 0)))
    data += encode(Kind.RATE, encode_counts((0, 0, rate, 0)))
    return data + (encode(Kind.MAGNETIC_FIELD, encode_counts((0, 300, -400, 0))) if field else b"")


def heading_turned(found: list[ImuSample]) -> float:
    """Return the angle about the vertical from the first to the last sample, rad."""
    (a, _, _, d), (w, _, _, z) = found[0].q_world_sensor, found[-1].q_world_sensor
    return 2 * atan2(a * z - d * w, a * w + d * z)


def test_raw_readings_turn_by_rate_times_device_time() -> None:
    pytest.importorskip("vqf")
    wit = decoder(orientation="gateway", settle_s=0)
    found = samples(run(wit, [raw_frames(10 * k, 0.5) for k in range(200)]))
    assert len(found) >= 198
    assert heading_turned(found) == pytest.approx(0.5 * 1.99, abs=0.02)
    assert found[-1].acceleration == pytest.approx((0.0, 0.0, 9.8))
    assert found[-1].ticks is None


def test_lost_and_glitched_readings_do_not_bend_the_orientation() -> None:
    pytest.importorskip("vqf")
    wire = [raw_frames(10 * k, 0.5) for k in range(200)]
    wire[50] = raw_frames(7_200_000, 0.5)
    wire[80] = wire[81] = b""
    wire[120] = wire[120][:11] + wire[120][22:]  # its acceleration was lost
    found = samples(run(decoder(orientation="gateway", settle_s=0), wire))
    assert heading_turned(found) == pytest.approx(0.5 * 1.99, abs=0.03)


def test_the_magnetometer_gives_the_heading() -> None:
    pytest.importorskip("vqf")
    wit = decoder(orientation="gateway", magnetometer=True, settle_s=0)
    found = samples(run(wit, [raw_frames(10 * k, 0.0, field=True) for k in range(100)]))
    assert found[-1].magnetic == (0.0, 300.0, -400.0)
    assert abs(found[-1].q_world_sensor[0]) == pytest.approx(1.0, abs=0.01)


def test_saturation_is_reported() -> None:
    pytest.importorskip("vqf")
    wit = decoder(orientation="gateway", settle_s=0)
    events = run(wit, [raw_frames(10 * k, 34.9) for k in range(20)])
    texts = [item.text for item in events if isinstance(item, DeviceEvent)]
    assert sum("out of range" in text for text in texts) == 1
