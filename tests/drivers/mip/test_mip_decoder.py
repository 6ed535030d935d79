"""Decoder of MIP devices: time, validity, data sets and faults."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample
from jointfit_drivers.mip import MipImu
from jointfit_protocols.mip import commands, encode
from jointfit_protocols.mip.data import STANDARD_GRAVITY, WEEK_NS, encode_field
from jointfit_simulators.devices._inertial_signals import InertialSignals
from tests.drivers.mip.mip_packets import PERIOD_NS, decoded, filter_packet, sensor_packet, settings

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.model import Decoded
    from jointfit_protocols.mip import MipField


def samples(events: list[Decoded]) -> list[ImuSample]:
    return [event for event in events if isinstance(event, ImuSample)]


def events_of(events: list[Decoded], kind: str) -> list[DeviceEvent]:
    return [one for one in events if isinstance(one, DeviceEvent) and one.kind == kind]


def test_a_filter_packet_is_a_sample_in_the_canonical_world() -> None:
    (sample,) = samples(decoded([filter_packet(123_456_789_012_345)]))
    assert sample.q_world_sensor == pytest.approx((0.28284, 0.84853, -0.14142, 0.42426), abs=1e-5)
    assert sample.ticks == 123_456_789_012_345
    assert sample.status == 1


def test_stamps_are_back_dated_by_the_bytes_at_the_line_speed() -> None:
    wire = filter_packet(0) + filter_packet(PERIOD_NS)
    decoder = MipImu(settings(baud=115_200)).decoder()
    first, second = samples(decoder.feed(Chunk(1_000_000_000, wire)))
    assert first.arrival_ns == 1_000_000_000 - round(len(wire) * 10e9 / 115_200)
    assert second.arrival_ns - first.arrival_ns == pytest.approx(len(wire) / 2 * 10e9 / 115_200, 1)


def test_invalid_orientations_are_dropped_and_reported_once() -> None:
    wires = [filter_packet(k * PERIOD_NS, valid=int(k >= 50)) for k in range(60)]
    found = decoded(wires)
    assert len(samples(found)) == 10
    assert ["invalid" in one.text for one in events_of(found, "warning")] == [True]
    assert events_of(found, "info")[0].text == "orientation valid again after 0.5 s"
    assert events_of(found, "gap") == []


def test_orientations_of_the_other_set_are_not_mixed_in_but_named() -> None:
    """`estimator` selects the data set: "filter" or "sensor". The other set is not used."""
    wires = [sensor_packet(k * PERIOD_NS) for k in range(30)]
    found = decoded(wires)
    assert samples(found) == []
    (warning,) = events_of(found, "warning")
    assert warning.text.endswith('set estimator = "sensor"')
    assert len(samples(decoded(wires, estimator="sensor"))) == 30


def test_time_of_another_set_is_not_used() -> None:
    """A packet of the sensor data set does not change the time of the filter data set."""
    pairs = [
        (sensor_packet(k * PERIOD_NS + 7_000_000), filter_packet(k * PERIOD_NS)) for k in range(20)
    ]
    found = decoded([packet for pair in pairs for packet in pair])
    assert [one.ticks for one in samples(found)] == [k * PERIOD_NS for k in range(20)]
    assert events_of(found, "restart") == []


def test_without_any_time_samples_carry_their_arrival_only() -> None:
    """If no packet has a time field, the samples have no device time."""
    found = decoded([filter_packet(None)] * 5)
    assert [one.ticks for one in samples(found)] == [None] * 5
    assert len(events_of(found, "warning")) == 1


def test_among_timed_orientations_those_without_time_are_rejected_and_reported_once() -> None:
    wires = [filter_packet(k * PERIOD_NS if k % 2 == 0 else None) for k in range(20)]
    found = decoded(wires)
    assert len(samples(found)) == 10
    assert sum(isinstance(one, Corrupt) for one in found) == 10
    assert "orientation's decimation" in events_of(found, "warning")[0].text
    assert len(events_of(found, "warning")) == 1


def test_legacy_time_counts_weeks_and_seconds() -> None:
    def packet(time_s: float) -> bytes:
        fields = (encode_field(0x82, 0x11, time_s, 2300, 3), encode_field(0x82, 3, 1, 0, 0, 0, 1))
        return encode(0x82, fields)

    ticks = [one.ticks for one in samples(decoded([packet(604_799.99), packet(604_799.995)]))]
    assert ticks == [2300 * WEEK_NS + 604_799_990_000_000, 2300 * WEEK_NS + 604_799_995_000_000]
    assert samples(decoded([packet(float("nan"))]))[0].ticks is None


def test_the_shared_time_of_week_is_the_device_time_of_packets_without_reference_time() -> None:
    def packet(time_s: float, *more: MipField) -> bytes:
        week = encode_field(0x82, 0xD3, time_s, 0, 0)
        return encode(0x82, (*more, encode_field(0x82, 3, 1, 0, 0, 0, 1), week))

    ticks = [one.ticks for one in samples(decoded([packet(12.5), packet(12.51)]))]
    assert ticks == [12_500_000_000, 12_510_000_000]
    both = decoded([packet(12.5, encode_field(0x82, 0xD5, 7_000_000))])
    assert samples(both)[0].ticks == 7_000_000


def test_lost_packets_are_counted() -> None:
    wires = [filter_packet(k * PERIOD_NS) if k not in {20, 21, 30} else b"" for k in range(40)]
    found = decoded(wires)
    assert [one.data["lost"] for one in events_of(found, "gap")] == [2, 1]


@pytest.mark.parametrize("restart_ns", [0, 5 * 3600 * 10**9])
def test_a_restart_is_reported_after_its_second_packet_and_loses_none(restart_ns: int) -> None:
    before = [filter_packet(3600 * 10**9 + k * PERIOD_NS) for k in range(40)]
    after = [filter_packet(restart_ns + k * PERIOD_NS) for k in range(10)]
    found = decoded(before + after)
    assert len(samples(found)) == 50
    assert len(events_of(found, "restart")) == 1
    assert events_of(found, "gap") == []


def test_a_single_corrupt_time_is_dropped() -> None:
    wires = [filter_packet(k * PERIOD_NS + (1 << 60) * (k == 20)) for k in range(40)]
    found = decoded(wires)
    assert len(samples(found)) == 39
    assert [one.reason for one in found if isinstance(one, Corrupt)] == [
        "time disagrees with the others"
    ]
    assert events_of(found, "restart") == []


def test_a_wrong_norm_is_rejected_and_a_wrong_scale_named() -> None:
    wires = [filter_packet(k * PERIOD_NS, q=(5.0, 0.0, 0.0, 0.0)) for k in range(120)]
    found = decoded(wires)
    assert samples(found) == []
    assert "median quaternion norm is 5" in events_of(found, "warning")[0].text


def test_device_information_and_transform_are_reported() -> None:
    info = commands.DeviceInformation(1105, "3DM-CV7-AHRS", "6286-9910", "6286.00042", "lot", "5g")
    wire = encode(1, ((0xF1, b"\x03\x00"), (0x81, commands.encode_info(info))))
    turned = encode(12, ((0xF1, b"\x32\x00"), (0xB2, commands.encode_floats(0.0, 1.0, 0.0, 0.0))))
    found = decoded([wire, turned])
    assert events_of(found, "info")[0].data["firmware"] == "1.1.05"
    assert events_of(found, "info")[1].data == {"sensor_to_vehicle": [0.0, 1.0, 0.0, 0.0]}
    assert "transform is stored" in events_of(found, "warning")[0].text
    level = encode(13, ((0xF1, b"\x11\x00"), (0x81, commands.encode_floats(0.0, 0.0, 0.0))))
    assert events_of(decoded([level]), "warning") == []


def test_a_refused_command_is_reported_and_an_unknown_one_is_not() -> None:
    nack, unknown = encode(12, ((0xF1, b"\x0f\x03"),)), encode(12, ((0xF1, b"\x32\x01"),))
    found = decoded([nack, unknown])
    assert [one.text for one in events_of(found, "warning")] == [
        "command 0x0C,0x0F refused: code 3, invalid parameter"
    ]


def test_a_raw_reading_that_is_refused_has_its_own_reason() -> None:
    pytest.importorskip("vqf")
    times = [0, PERIOD_NS, PERIOD_NS, 2 * PERIOD_NS]
    wires = [
        encode(
            0x80,
            (
                encode_field(0x80, 0xD5, t_ns),
                encode_field(0x80, 4, 0.0, 0.0, 1.0),
                encode_field(0x80, 5, 0.0, 0.0, 900.0 if number == 3 else 0.0),
            ),
        )
        for number, t_ns in enumerate(times)
    ]
    found = decoded(wires, orientation="gateway", settle_s=0.0)
    assert [one.reason for one in found if isinstance(one, Corrupt)] == [
        "raw measurements with the time of the previous ones",
        "raw measurements out of range",
    ]


def test_raw_measurements_are_in_si_units() -> None:
    pytest.importorskip("vqf")
    signals = InertialSignals()
    wires = []
    for k in range(30):
        signals.update(k * PERIOD_NS, (1.0, 0.0, 0.0, 0.0))
        force = tuple(value / STANDARD_GRAVITY for value in signals.force)
        fields = ((0xD5, (k * PERIOD_NS,)), (4, force), (5, signals.rate))
        wires.append(encode(0x80, (encode_field(0x80, one, *values) for one, values in fields)))
    found = samples(decoded(wires, orientation="gateway", settle_s=0.0))
    assert len(found) == 30
    assert found[-1].acceleration == pytest.approx((0.0, 0.0, 9.81), abs=1e-5)
    w, x, y, _ = found[-1].q_world_sensor
    assert (x, y) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert abs(w) <= 1.0


@given(
    st.lists(
        st.tuples(st.integers(0, 2**64 - 1), st.binary(max_size=20), st.integers(0, 10**12)),
        max_size=30,
    )
)
def test_hostile_packets_never_raise(content: list[tuple[int, bytes, int]]) -> None:
    for estimator in ("filter", "sensor"):
        decoder = MipImu(settings(estimator=estimator)).decoder()
        t_ns = 0
        for device_ns, data, step_ns in content:
            t_ns += step_ns
            decoder.feed(Chunk(t_ns, filter_packet(device_ns) + sensor_packet(device_ns)))
            decoder.feed(Chunk(t_ns, encode(0x80, ((0x0A, data), (0x12, data)))))
            decoder.feed(Chunk(t_ns, encode(0x0C, ((0xF1, data), (0xB2, data), (0x8F, data)))))
        decoder.flush()


def test_the_recording_has_no_orientation_of_the_device(shared_data: Path) -> None:
    wire = (shared_data / "imu" / "microstrain" / "mip_data.bin").read_bytes()
    decoder = MipImu(settings()).decoder()
    found = decoder.feed(Chunk(0, wire)) + decoder.flush()
    assert samples(found) == []
    assert (decoder.messages, decoder.discarded_bytes) == (8384, 0)


def test_raw_measurements_of_the_recording_give_an_orientation_each(shared_data: Path) -> None:
    """All 4473 packets have time, acceleration and rate; the sensor lies flat with z down."""
    pytest.importorskip("vqf")
    wire = (shared_data / "imu" / "microstrain" / "mip_data.bin").read_bytes()
    decoder = MipImu(settings(orientation="gateway", rate_hz=125, settle_s=0)).decoder()
    found: list[Decoded] = []
    for at in range(0, len(wire), 82):  # 36 s of data at a steady pace
        found += decoder.feed(Chunk(round(at / len(wire) * 35.776e9), wire[at : at + 82]))
    kept = samples(found + decoder.flush())
    assert len(kept) == 4473
    assert events_of(found, "gap") == events_of(found, "restart") == []
    _, x, y, _ = kept[-1].q_world_sensor
    up_z = 1.0 - 2.0 * (x * x + y * y)
    assert up_z < -0.97
