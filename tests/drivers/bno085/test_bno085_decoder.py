"""Decoders of the BNO085: axis orders, ages, report numbers, damaged data and restarts."""

from __future__ import annotations

import struct
from math import atan2
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample
from jointfit_drivers.bno085 import Bno085Imu, Bno085Settings
from jointfit_drivers.bno085._rvc_decoder import gravity_of, quaternion_of
from jointfit_protocols.bno085 import (
    HubReport,
    HubReportId,
    RvcFrame,
    ShtpChannel,
    encode_base_time,
    encode_report,
    encode_rvc,
    encode_shtp,
)
from jointfit_simulators.devices._bno085_device import euler_deg

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded

PERIOD_NS = 10_000_000
EXAMPLE = (1, -110, 2085)
ANGLES = st.tuples(
    st.integers(-17_999, 17_999), st.integers(-8_999, 8_999), st.integers(-17_999, 17_999)
)


def decoder(baud: int, **more: Any) -> Any:
    table: dict[str, Any] = {"id": "S1", "segment": "thigh", "driver": "bno085", "port": "p"}
    return Bno085Imu(Bno085Settings(**table | {"baud": baud} | more)).decoder()


def run(bno: Any, pieces: list[bytes]) -> list[Decoded]:
    return [
        item for k, data in enumerate(pieces, 1) for item in bno.feed(Chunk(k * PERIOD_NS, data))
    ]


def samples(events: list[Decoded]) -> list[ImuSample]:
    return [event for event in events if isinstance(event, ImuSample)]


def texts(events: list[Decoded]) -> list[str]:
    return [event.text for event in events if isinstance(event, DeviceEvent)]


# --- UART-RVC ---------------------------------------------------------------------------------


@pytest.mark.parametrize("euler", ["zxy", "zyx"])
@given(angles=ANGLES)
def test_angles_give_the_rotation_that_scipy_gives(
    euler: Literal["zxy", "zyx"], angles: tuple[int, int, int]
) -> None:
    q = quaternion_of(angles, euler)
    true = Rotation.from_euler(euler.upper(), np.multiply(angles, 0.01), degrees=True)
    x, y, z, w = true.as_quat()
    assert abs(np.dot(q, (w, x, y, z))) == pytest.approx(1.0, abs=1e-12)
    assert gravity_of(angles, euler) == pytest.approx(true.inv().apply((0, 0, 1)), abs=1e-12)
    again = Rotation.from_euler(euler.upper(), euler_deg(q, euler), degrees=True)
    assert (again * true.inv()).magnitude() < 1e-6


def test_the_message_of_the_data_sheet_fits_pitch_about_x_and_roll_about_y() -> None:
    """In this message, the acceleration agrees with the angles only in the Euler order zxy."""
    measured = np.array((-371, -20, 977)) / np.linalg.norm((-371, -20, 977))
    assert gravity_of(EXAMPLE, "zxy") == pytest.approx(measured, abs=0.002)
    cosine = gravity_of(EXAMPLE, "zyx") @ measured
    assert np.degrees(np.arccos(cosine)) == pytest.approx(31.0, abs=0.5)  # docs/devices/bno085.md


@pytest.mark.parametrize(("euler", "reported"), [("zxy", False), ("zyx", True)])
def test_accelerations_at_rest_reveal_the_wrong_order(euler: str, reported: bool) -> None:
    """A configured Euler order that contradicts the acceleration at rest is reported."""
    frames = [encode_rvc(RvcFrame(k & 0xFF, EXAMPLE, (-371, -20, 977))) for k in range(150)]
    found = texts(run(decoder(115_200, euler=euler), frames))
    assert any('fit euler = "zxy", not "zyx"' in text for text in found) == reported
    assert len(found) == reported


def test_a_level_or_moving_device_reveals_nothing() -> None:
    """The Euler order can only be checked with a tilted device at rest."""
    level = [encode_rvc(RvcFrame(k & 0xFF, (k, 5, -5), (0, 0, 1000))) for k in range(256)]
    moving = [encode_rvc(RvcFrame(k & 0xFF, EXAMPLE, (900, 900, 977))) for k in range(256)]
    assert texts(run(decoder(115_200, euler="zyx"), level + moving)) == []


def test_lost_frames_are_counted_across_the_wrap() -> None:
    numbers = [253, 254, 255, 0, 3, 4]
    frames = [encode_rvc(RvcFrame(k, EXAMPLE, (-371, -20, 977))) for k in numbers]
    events = run(decoder(115_200), frames)
    assert texts(events) == ["2 messages lost"]
    assert [item.counter for item in samples(events)] == numbers
    assert samples(events)[0].acceleration == pytest.approx((-3.638, -0.196, 9.581), abs=0.001)


# --- UART-SHTP --------------------------------------------------------------------------------


def packet(*reports: HubReport, age: int = 0) -> bytes:
    payload = encode_base_time(age) + b"".join(map(encode_report, reports))
    return encode_shtp(ShtpChannel.INPUT, 0, payload)


def rotation(
    number: int = 0,
    delay: int = 0,
    status: int = 3,
    values: tuple[float, ...] = (0.0, 0.0, 0.6, 0.8, 0.05),
) -> HubReport:
    return HubReport(HubReportId.ROTATION_VECTOR, number, status, delay, values)


def test_the_real_part_comes_last_and_a_sample_is_older_than_its_packet() -> None:
    """A report contains x, y, z, w in this order. The packet contains the age of its reports."""
    bno = decoder(3_000_000, transport="usb")
    (sample,) = samples(bno.feed(Chunk(10**9, b"\x7e" + packet(rotation(7, delay=20), age=50))))
    assert sample.q_world_sensor == pytest.approx((0.8, 0.0, 0.0, 0.6), abs=1e-4)
    assert sample.arrival_ns == 10**9 - 3_000_000
    assert (sample.counter, sample.status, sample.ticks) == (7, 3, None)


def test_several_measurements_in_a_packet_have_their_own_age() -> None:
    bno = decoder(3_000_000, transport="usb")
    reports = [rotation(k, delay=25 * k) for k in range(3)]
    found = samples(bno.feed(Chunk(10**9, b"\x7e" + packet(*reports, age=60))))
    assert [10**9 - item.arrival_ns for item in found] == [6_000_000, 3_500_000, 1_000_000]


def test_lost_reports_restarts_and_accuracy_are_events() -> None:
    reset = encode_shtp(ShtpChannel.EXECUTABLE, 0, b"\x01")
    wire = [b"\x7e" + reset, *(packet(rotation(k)) for k in (254, 255, 3))]
    wire += [packet(rotation(4, status=1)), reset, packet(rotation(0))]
    events = run(decoder(3_000_000), wire)
    assert texts(events) == [
        "accuracy of the orientation: high", "3 messages lost",
        "accuracy of the orientation: low", "device restarted: it lost its settings",
        "accuracy of the orientation: high",
    ]  # fmt: skip
    assert len(samples(events)) == 5


def channel_5(number: int, *rows: tuple[int, ...]) -> bytes:
    """Return a packet as the device sends it: values alone, without base time and report header."""
    body = b"".join(struct.pack("<7h", *row) for row in rows)
    return b"\x7e\x01" + struct.pack("<HBB", len(body) + 4, 5, number) + body + b"\x7e"


def test_gyro_rotation_vectors_of_channel_5_have_rates_but_no_age() -> None:
    row = (0, 0, 9830, 13107, 1024, -512, 256)  # units: 2^-14 (quaternion), 2^-10 rad/s (rates)
    bno = decoder(3_000_000, transport="usb")
    wire = channel_5(9, row, row) + channel_5(12, row)
    events = bno.feed(Chunk(10**9, wire))
    assert [item.counter for item in samples(events)] == [9, 9, 12]
    assert texts(events) == ["2 messages lost"]
    for item in samples(events):
        assert item.q_world_sensor == pytest.approx((0.8, 0.0, 0.0, 0.6), abs=1e-4)
        assert (item.rate, item.arrival_ns) == ((1.0, -0.5, 0.25), 10**9)
    (damaged,) = bno.feed(Chunk(2 * 10**9, channel_5(13, row)[:-3] + b"\x7e"))
    assert isinstance(damaged, Corrupt)
    assert bno.discarded_bytes == 17


def test_one_kind_of_rotation_vectors_is_used() -> None:
    """Rotation vectors of another kind are used only until the configured kind arrives."""
    game = HubReport(HubReportId.GAME_ROTATION_VECTOR, 1, 3, 0, (0.6, 0.0, 0.0, 0.8))
    wire = [b"\x7e" + packet(game), packet(game, rotation(1)), packet(game, rotation(2))]
    found = [item.q_world_sensor for item in samples(run(decoder(3_000_000), wire))]
    both = [(0.8, 0.6, 0.0, 0.0)] * 2 + [(0.8, 0.0, 0.0, 0.6)] * 2
    for q, expected in zip(found, both, strict=True):
        assert q == pytest.approx(expected, abs=1e-4)
    other = decoder(3_000_000, report="game_rotation_vector")
    assert {round(item.q_world_sensor[1], 1) for item in samples(run(other, wire))} == {0.6}


def test_damage_is_rejected_and_counted() -> None:
    bno = decoder(3_000_000)
    bad = [
        packet(rotation(values=(0.0, 0.0, 0.3, 0.8, 0.0))),
        packet(rotation(), age=50_000),
        encode_shtp(ShtpChannel.INPUT, 0, b"\x99\x01"),
        packet(rotation())[:-4] + b"\x7e",
    ]
    events = run(bno, [b"\x7e" + bad[0], *bad[1:], packet(rotation())])
    assert [item.reason for item in events if isinstance(item, Corrupt)] == [
        "quaternion norm is not 1", "time out of range", "reports do not fill the packet", "length"
    ]  # fmt: skip
    assert len(samples(events)) == 1
    assert bno.messages == 1


def test_raw_readings_turn_by_rate_times_measured_time() -> None:
    """The device is 4 % slower than requested; its period is measured from the arrivals."""
    pytest.importorskip("vqf")
    bno = decoder(3_000_000, orientation="gateway", settle_s=0, rate_hz=100, transport="usb")
    found: list[Decoded] = []
    for k in range(3000):
        force = HubReport(HubReportId.ACCELEROMETER, k & 0xFF, 3, 0, (0.0, 0.0, 9.8))
        values = (0.0, 0.0, 0.5, 0.0, 0.0, 0.0)
        rate = HubReport(HubReportId.GYROSCOPE_UNCALIBRATED, k & 0xFF, 3, 0, values)
        found += bno.feed(Chunk(10_400_000 * (k + 1), b"\x7e" + packet(force, rate)))
    turned = samples(found)
    (a, _, _, d), (w, _, _, z) = turned[1000].q_world_sensor, turned[-1].q_world_sensor
    angle = 2 * atan2(a * z - d * w, a * w + d * z)
    true = 0.5 * 0.0104 * (len(turned) - 1001)
    assert (angle - true + np.pi) % (2 * np.pi) - np.pi == pytest.approx(0.0, abs=0.02 * true)
