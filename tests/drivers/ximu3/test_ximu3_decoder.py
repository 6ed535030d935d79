"""The decoder of the x-IMU3 driver: samples, worlds, gaps, restarts, corruption, reports."""

from __future__ import annotations

import json
import math
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample, SyncPulse
from jointfit_drivers.ximu3 import XImu3Decoder, XImu3Settings
from jointfit_protocols.orientation import canonical, native_of
from jointfit_protocols.ximu3 import (
    encode_command,
    encode_data,
    encode_multiplexed,
    encode_text,
)
from jointfit_simulators.devices._rotations import roll_pitch_yaw_deg, rotation_rows

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.model import Decoded, Quaternion

BYTE_NS = 86_805.5556  # ten bits at 115200 baud
PERIOD_US = 10_000


def decoder(**keys: Any) -> XImu3Decoder:
    table: dict[str, Any] = {"id": "S1", "segment": "thigh", "driver": "ximu3", "port": "p"}
    return XImu3Decoder(XImu3Settings(**table | keys))


def swing(number: float) -> Quaternion:
    """Return the orientation of sample `number` in a smooth motion with accelerations."""
    angle = 0.4 * math.sin(0.05 * number)
    return (math.cos(angle), 0.6 * math.sin(angle), 0.0, 0.8 * math.sin(angle))


def message(number: int, q: tuple[float, ...] | None = None, ticks: int | None = None) -> bytes:
    ticks = 1_000_000 + number * PERIOD_US if ticks is None else ticks
    return encode_data("Q", ticks, swing(number) if q is None else q)


def fed(decoder: XImu3Decoder, *wires: bytes, period_ns: int = 10_000_000) -> list[Decoded]:
    return [
        event
        for number, wire in enumerate(wires)
        for event in decoder.feed(Chunk(number * period_ns, wire))
    ]


def samples(events: list[Decoded]) -> list[ImuSample]:
    return [event for event in events if isinstance(event, ImuSample)]


def reports(events: list[Decoded], *kinds: str) -> list[str]:
    return [event.text for event in events if isinstance(event, DeviceEvent) if event.kind in kinds]


def angle_between(p: tuple[float, ...], q: tuple[float, ...]) -> float:
    return 2.0 * math.acos(min(abs(sum(a * b for a, b in zip(p, q, strict=True))), 1.0))


@pytest.mark.parametrize("size", [1, 33, 100_000])
def test_the_recording_gives_202_samples_and_one_refused_message(
    shared_data: Path, size: int
) -> None:
    wire = (shared_data / "imu" / "ximu3" / "synthetic_quaternion.ximu3").read_bytes()
    subject = decoder()
    events = fed(subject, *(wire[at : at + size] for at in range(0, len(wire), size)), period_ns=0)
    found = samples(events)
    assert len(found) == subject.messages == 202
    assert (found[0].ticks, found[-1].ticks) == (1_000_000, 2_990_001)
    assert [event for event in events if not isinstance(event, ImuSample)] == [
        Corrupt(32, "quaternion norm is not 1", rejected=1)
    ]
    assert subject.discarded_bytes == 32


def test_the_log_of_a_device_has_one_gap(shared_data: Path) -> None:
    rows = (shared_data / "imu" / "ximu3" / "logged" / "Quaternion.csv").read_text("utf-8")
    wires = []
    for row in rows.splitlines()[1:]:
        ticks, *parts = row.split(",")
        wires.append(encode_data("Q", int(ticks), list(map(float, parts))))
    events = fed(decoder(rate_hz=50), *wires, period_ns=19_990_500)
    found = samples(events)
    assert len(found) == 103
    assert reports(events, "gap", "restart", "warning") == ["1 messages lost"]
    # The factory setting is NWU, and the sensor lies flat: north is y of the canonical world.
    assert angle_between(found[0].q_world_sensor, (math.sqrt(0.5), 0, 0, math.sqrt(0.5))) < 0.01


def test_every_vector_with_an_orientation_gives_the_canonical_one(shared_data: Path) -> None:
    checked = 0
    for vector in json.loads((shared_data / "imu" / "vectors.json").read_text("utf-8")):
        expected = vector.get("decoded", {}).get("canonical_wxyz")
        if vector["protocol"] == "ximu3" and expected is not None:
            (sample,) = samples(fed(decoder(), bytes.fromhex(vector["hex"])))
            assert angle_between(sample.q_world_sensor, tuple(expected)) < 1e-3
            checked += 1
    assert checked == 4


@pytest.mark.parametrize(("number", "world"), list(enumerate(("NWU", "ENU", "NED"))))
def test_the_world_is_that_which_the_device_reports(number: int, world: Any) -> None:
    subject = decoder()
    reply = encode_command("ahrs_axes_convention", number)
    native = native_of(swing(7), world)
    events = fed(subject, reply, encode_data("Q", 1, native))
    assert reports(events, "info") == [f"world {world}"]
    (sample,) = samples(events)
    assert angle_between(sample.q_world_sensor, swing(7)) < 1e-3
    assert angle_between(sample.q_native, native) < 1e-3


def test_a_change_of_the_world_is_reported_and_used() -> None:
    subject = decoder()
    fed(subject, encode_command("ahrs_axes_convention", 0), *map(message, range(20)))
    events = fed(subject, encode_command("ahrs_axes_convention", 2), *map(message, range(20, 23)))
    assert reports(events, "setting") == ["world changed from NWU to NED"]
    expected = [canonical(swing(number), "NED") for number in range(20, 23)]
    assert all(
        angle_between(sample.q_world_sensor, q) < 1e-3
        for sample, q in zip(samples(events), expected, strict=True)
    )


@given(st.integers(-200, 200), st.integers(-200, 200))
def test_matrices_and_angles_give_the_orientation_of_the_quaternion(one: int, other: int) -> None:
    a, b = one * math.pi / 200, other * math.pi / 200
    q = (math.cos(a) * math.cos(b), math.cos(a) * math.sin(b), math.sin(a) * math.cos(b),
         math.sin(a) * math.sin(b))  # fmt: skip
    matrix = tuple(value for row in rotation_rows(q) for value in row)
    wires = (encode_data("R", 1, matrix), encode_data("A", 1, roll_pitch_yaw_deg(q)))
    for wire in wires:
        (sample,) = samples(fed(decoder(world="ENU"), wire))
        assert angle_between(sample.q_world_sensor, q) < 2e-3


def test_a_matrix_that_is_no_rotation_is_refused() -> None:
    mirror = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0)
    assert fed(decoder(), encode_data("R", 1, mirror), encode_data("R", 2, 9 * (0.5,))) == 2 * [
        Corrupt(46, "rotation matrix is not orthonormal", rejected=1)
    ]


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
def test_euler_angles_that_are_not_finite_are_refused(value: float) -> None:
    wire = encode_data("A", 1, (0.0, value, 0.0))
    assert fed(decoder(), wire) == [Corrupt(len(wire), "Euler angles are not finite", rejected=1)]


def test_older_firmware_sends_the_quaternion_with_accelerations() -> None:
    wire = encode_data("E", 1, (*swing(3), 0.0, 0.0, 0.0))
    assert len(samples(fed(decoder(), wire))) == 1
    assert fed(decoder(), encode_data("E", 1, (0.0, 0.0, 0.0))) == []


def test_a_sample_is_stamped_with_the_arrival_of_its_first_byte() -> None:
    wire = message(0) + message(1) + b"\xd1"
    first, second = samples(decoder().feed(Chunk(10**9, wire)))
    assert second.arrival_ns == pytest.approx(10**9 - 27 * BYTE_NS, abs=2)
    assert first.arrival_ns == pytest.approx(10**9 - 53 * BYTE_NS, abs=2)
    usb = samples(decoder(transport="usb").feed(Chunk(10**9, wire)))
    assert [sample.arrival_ns for sample in usb] == [10**9, 10**9]


@given(st.lists(st.binary(max_size=60) | st.integers(0, 50).map(message), max_size=12))
def test_any_bytes_give_events_and_every_lost_byte_is_counted(wires: list[bytes]) -> None:
    for keys in ({}, {"sync_wire": 1}):
        subject = decoder(**keys)
        events = fed(subject, *wires) + subject.flush()
        lost = sum(event.discarded for event in events if isinstance(event, Corrupt))
        assert lost == subject.discarded_bytes <= sum(map(len, wires))


def test_lost_messages_are_counted() -> None:
    wires = [message(number) for number in range(40) if number not in {20, 21, 22, 30}]
    events = fed(decoder(), *wires)
    assert len(samples(events)) == 36
    assert reports(events, "gap") == ["3 messages lost", "1 messages lost"]


def test_a_long_gap_is_no_restart_if_the_arrival_times_agree() -> None:
    subject = decoder()
    before = fed(subject, *map(message, range(30)))
    wires = [message(number) for number in range(230, 240)]
    after = [
        event
        for number, wire in enumerate(wires, 230)
        for event in subject.feed(Chunk(number * 10_000_000, wire))
    ]
    assert len(samples(before)) == 30
    assert len(samples(after)) == 10
    assert reports(after, "gap", "restart") == ["200 messages lost"]


def test_a_restart_of_the_clock_is_reported_before_its_samples() -> None:
    wires = [message(number, ticks=(number % 30) * PERIOD_US + 5) for number in range(60)]
    events = fed(decoder(), *wires)
    assert reports(events, "gap", "restart") == ["device clock restarted at 5 us"]
    assert len(samples(events)) == 60
    at = next(n for n, event in enumerate(events) if isinstance(event, DeviceEvent))
    assert len(samples(events[:at])) == 30


@pytest.mark.parametrize("part", range(4))
def test_a_flipped_sign_that_no_checksum_detects_is_dropped(part: int) -> None:
    q = [value * (-1 if k == part else 1) for k, value in enumerate(swing(45))]
    wires = [message(number) for number in range(60)]
    wires[45] = message(45, tuple(q))
    events = fed(decoder(), *wires)
    harmless = angle_between(tuple(q), swing(45)) < 0.03
    assert len(samples(events)) == 59 + harmless
    worst = max(
        angle_between(sample.q_world_sensor, canonical(swing(n), "NWU"))
        for sample in samples(events)
        if sample.ticks is not None
        for n in [(sample.ticks - 1_000_000) // PERIOD_US]
    )
    assert worst < 0.03
    assert reports(events, "gap", "restart") == []


def test_a_time_with_a_flipped_bit_is_dropped() -> None:
    wires = [message(number) for number in range(60)]
    for bit in (19, 25, 40, 51):
        wires[45] = message(45, ticks=(1_000_000 + 45 * PERIOD_US) ^ (1 << bit))
        events = fed(decoder(), *wires)
        assert len(samples(events)) == 59
        assert reports(events, "gap", "restart") == []
    wires[45] = message(45, ticks=1 << 60)
    assert Corrupt(26, "device time out of range", rejected=1) in fed(decoder(), *wires)


def test_a_sudden_motion_is_delayed_by_one_message_and_complete() -> None:
    """The angular rate changes from 0 to 30 rad/s between two samples."""
    angles = [0.0] * 50 + [0.15 * number for number in range(1, 20)]
    wires = [message(n, (math.cos(a), math.sin(a), 0.0, 0.0)) for n, a in enumerate(angles)]
    events = fed(decoder(), *wires)
    assert len(samples(events)) == len(angles)
    assert not any(isinstance(event, Corrupt) for event in events)


def test_a_device_at_another_rate_is_reported_once() -> None:
    events = fed(decoder(rate_hz=50), *map(message, range(60)))
    assert reports(events, "warning") == [
        "the device sends at 100 Hz, rate_hz is 50: correct one of them"
    ]
    assert reports(events, "gap") == []


def test_a_rate_that_is_halved_is_no_loss_for_ever() -> None:
    wires = [message(number) for number in (*range(30), *range(30, 130, 2))]
    assert len(reports(fed(decoder(), *wires), "gap")) == 19


def test_quaternions_of_another_scale_are_named() -> None:
    wires = [message(n, tuple(3.0 * part for part in swing(n))) for n in range(120)]
    events = fed(decoder(), *wires)
    assert samples(events) == []
    assert reports(events, "warning") == [
        "median quaternion norm is 3, expected 1: order or scale is wrong"
    ]
    events = fed(decoder(), *(message(n, (math.nan,) * 4) for n in range(120)))
    (warning,) = (e for e in events if isinstance(e, DeviceEvent) and e.kind == "warning")
    assert warning.data == {}


def test_edges_are_pulses_of_the_configured_wire() -> None:
    edges = [encode_data("Y", 1_090_000 + 1000 * n, (float(n % 2),)) for n in range(4)]
    wires = (*map(message, range(10)), *edges, encode_data("Y", 10**12, (1.0,)))
    rising = fed(decoder(sync_wire=2), *wires)
    pulses = [event for event in rising if isinstance(event, SyncPulse)]
    assert [(pulse.ticks, pulse.line) for pulse in pulses] == [(1_091_000, 2), (1_093_000, 2)]
    assert [event for event in rising if isinstance(event, Corrupt)] == [
        Corrupt(14, "time of an edge is far from the time of the measurements", rejected=1)
    ]
    falling = fed(decoder(sync_wire=2, sync_edge="falling"), *wires[:-1])
    assert [e.ticks for e in falling if isinstance(e, SyncPulse)] == [1_090_000, 1_092_000]
    assert not any(isinstance(event, SyncPulse) for event in fed(decoder(), *wires))


def test_messages_of_a_multiplexer_are_those_of_other_devices() -> None:
    wires = [encode_multiplexed(0x41, message(n)) for n in range(5)]
    subject = decoder()
    assert fed(subject, *wires, encode_multiplexed(0x41, encode_command("ping", "x"))) == []
    assert (subject.messages, subject.discarded_bytes) == (6, 0)


def test_replies_are_properties_of_the_device() -> None:
    replies = {
        "ping": {"interface": "USB", "name": "x-IMU3", "sn": "0123"},
        "firmware_version": "v1.2.3",
        "axes_alignment": 9,
        "ahrs_ignore_magnetometer": True,
        "bogus": {"error": "Unknown command"},
        "note": None,
    }
    events = fed(decoder(), *(encode_command(*pair) for pair in replies.items()))
    assert reports(events, "info") == [
        "model x-IMU3, name x-IMU3, serial 0123, interface USB", "firmware v1.2.3",
        "axes_alignment 9", "ahrs_ignore_magnetometer True",
    ]  # fmt: skip
    assert reports(events, "warning") == [
        "axes_alignment is 9 (+Y-Z-X): the sensor axes are not those printed on the housing",
        "command bogus refused: Unknown command",
    ]


def test_errors_and_a_low_battery_are_reported() -> None:
    charges = (80.0, 9.0, 8.0, 12.0, 50.0, 5.0)
    events = fed(
        decoder(),
        encode_text("F", 1, b"Data logger full"),
        encode_text("N", 1, b"Button held"),
        *(encode_data("B", 1, (charge, 3.7, 0.0)) for charge in charges),
    )
    assert reports(events, "error") == ["device reports: Data logger full"]
    assert reports(events, "info") == ["device reports: Button held"]
    assert reports(events, "warning") == [
        "battery 9 %: charge it, or connect USB", "battery 5 %: charge it, or connect USB",
    ]  # fmt: skip


def test_raw_messages_give_the_orientation_with_magnetic_heading() -> None:
    """The sensor turns about the vertical. Every fifth sample contains the magnetic field."""
    pytest.importorskip("vqf")
    subject = decoder(orientation="gateway", magnetometer=True)
    wires, rate = [], 30.0  # deg/s
    for number in range(1500):
        ticks, heading = 1_000_000 + number * PERIOD_US, math.radians(rate * number / 100)
        turning = rate if number else 0.0
        wires.append(encode_data("I", ticks, (0.0, 0.0, turning, 0.0, 0.0, 1.0)))
        if number % 5 == 0:
            north = (math.sin(heading), math.cos(heading))  # sensor axes; x is east at heading 0
            wires[-1] = encode_data("M", ticks, (0.4 * north[0], 0.4 * north[1], -0.9)) + wires[-1]
    found = samples(fed(subject, *wires))
    assert len(found) > 500
    last = found[-1]
    assert last.ticks is not None
    heading = math.radians(rate * (last.ticks - 1_000_000) / 1e6)
    expected = (math.cos(heading / 2), 0.0, 0.0, math.sin(heading / 2))
    assert angle_between(last.q_world_sensor, expected) < math.radians(0.5)
    assert last.acceleration == pytest.approx((0.0, 0.0, 9.80665), abs=1e-3)
    assert last.rate is None


def test_raw_values_out_of_range_are_refused() -> None:
    pytest.importorskip("vqf")
    subject = decoder(orientation="gateway")
    good = [encode_data("I", n * PERIOD_US, (0.0, 0.0, 0.0, 0.0, 0.0, 1.0)) for n in range(5)]
    bad = encode_data("I", 5 * PERIOD_US, (math.nan, 0.0, 0.0, 0.0, 0.0, 1.0))
    assert fed(subject, *good, bad)[-1] == Corrupt(34, "raw values out of range", rejected=1)
