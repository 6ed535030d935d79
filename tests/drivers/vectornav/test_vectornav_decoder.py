"""Decoder of VectorNav devices: time, coordinate frames, registers and faults."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample
from jointfit_daemon.tools.discovery._traffic import decode_traffic
from jointfit_drivers.vectornav import VectorNavImu
from jointfit_drivers.xbus import XbusImu
from jointfit_protocols import xbus
from jointfit_protocols.vectornav import Field, encode_binary, encode_text
from jointfit_protocols.xbus import mtdata2
from tests.drivers.vectornav.vectornav_messages import PERIOD_NS, decoded, output, settings

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded


def samples(events: list[Decoded]) -> list[ImuSample]:
    return [event for event in events if isinstance(event, ImuSample)]


def events_of(events: list[Decoded], kind: str) -> list[DeviceEvent]:
    return [one for one in events if isinstance(one, DeviceEvent) and one.kind == kind]


def test_an_output_is_a_sample_in_the_canonical_world() -> None:
    (sample,) = samples(decoded([output(123)]))
    assert sample.q_native == pytest.approx((0.5, -0.5, 0.1, 0.7))
    assert sample.q_world_sensor == pytest.approx((0.28284, 0.84853, -0.14142, 0.42426), abs=1e-5)
    assert sample.ticks == 123


def test_the_inverse_direction_is_a_setting() -> None:
    (sample,) = samples(decoded([output(123)], direction="world_to_sensor"))
    (inverse,) = samples(decoded([output(123, (0.5, 0.5, -0.1, -0.7))]))
    assert sample.q_world_sensor == pytest.approx(inverse.q_world_sensor)


def test_a_second_output_without_orientation_changes_nothing() -> None:
    other = encode_binary({Field.TIME_STARTUP: (5,), Field.YAW_PITCH_ROLL: (1.0, 2.0, 3.0)})
    found = decoded([output(k * PERIOD_NS) + other for k in range(20)])
    assert len(samples(found)) == 20
    assert events_of(found, "restart") == []


def test_lost_messages_and_a_restart_are_reported() -> None:
    times = [k * PERIOD_NS for k in range(40) if k not in {20, 21}] + [
        k * PERIOD_NS for k in range(10)
    ]
    found = decoded([output(t_ns) for t_ns in times])
    assert len(samples(found)) == 48
    assert [one.data["lost"] for one in events_of(found, "gap")] == [2]
    assert len(events_of(found, "restart")) == 1


def test_a_single_corrupt_time_is_dropped() -> None:
    found = decoded([output(k * PERIOD_NS + (1 << 60) * (k == 20)) for k in range(40)])
    assert len(samples(found)) == 39
    assert len([one for one in found if isinstance(one, Corrupt)]) == 1


def test_without_time_samples_carry_their_arrival_and_the_remedy_is_named() -> None:
    found = decoded([output(None)] * 5)
    assert [one.ticks for one in samples(found)] == [None] * 5
    (warning,) = events_of(found, "warning")
    assert "TimeStartup" in warning.text


def test_registers_and_errors_are_reported() -> None:
    texts = ("VNRRG,01,VN-100S", "VNRRG,75,3,8,01,0011", "VNERR,0C", "VNRRG,26,1,0,0,0,-1,0,0,0,-1")
    found = decoded([encode_text(text) for text in texts])
    known = {key: value for one in events_of(found, "info") for key, value in one.data.items()}
    assert known["model"] == "VN-100S"
    assert known["output_1"] == [3, 8, "0x00", "0x04"]
    assert known["reference_frame"] == [1, 0, 0, 0, -1, 0, 0, 0, -1]
    baud, rotation = events_of(found, "warning")
    assert "insufficient baud rate" in baud.text
    assert "register 26" in rotation.text
    assert events_of(decoded([encode_text("VNRRG,26,1,0,0,0,1,0,0,0,1")]), "warning") == []


def test_raw_measurements_are_in_si_units() -> None:
    pytest.importorskip("vqf")
    wire = [
        encode_binary(
            {
                Field.TIME_STARTUP: (k * PERIOD_NS,),
                Field.ANGULAR_RATE: (0.0, 0.0, 0.1),
                Field.ACCELERATION: (0.0, 0.0, 9.81),
                Field.MAGNETIC_AND_PRESSURE: (0.2, 0.0, -0.4, 25.0, 101.3),
            }
        )
        for k in range(30)
    ]
    found = samples(decoded(wire, orientation="gateway", magnetometer=True, settle_s=0.0))
    assert found[-1].acceleration == pytest.approx((0.0, 0.0, 9.81))
    assert found[-1].magnetic == pytest.approx((0.2, 0.0, -0.4))


def test_the_probe_tells_the_two_families_with_the_byte_fa_apart() -> None:
    """As in `jointfit probe`, only the decoder of the right family returns samples."""
    item = mtdata2.Item
    q = (0.5, -0.5, 0.1, 0.7)
    xsens = [
        xbus.encode(0x36, mtdata2.encode_items([
            (item.PACKET_COUNTER, k), (item.SAMPLE_TIME_FINE, 100 * k), (item.QUATERNION, q)]))
        for k in range(200)
    ]  # fmt: skip
    ours = [output(k * PERIOD_NS) for k in range(200)]
    for wires, driver, other in ((ours, "vectornav", "xbus"), (xsens, "xbus", "vectornav")):
        chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(wires)]
        classes = {"vectornav": VectorNavImu, "xbus": XbusImu}
        found = decode_traffic(classes[driver], driver, {"baud": 115_200}, chunks)
        assert found is not None
        assert found.samples == 200
        assert decode_traffic(classes[other], other, {"baud": 115_200}, chunks) is None


def test_the_probe_recognizes_the_factory_setting_without_orientations() -> None:
    lines = [encode_text(f"VNYMR,+{k:07.3f},-007.330,+000.715") for k in range(20)]
    chunks = [Chunk(k * PERIOD_NS, data) for k, data in enumerate(lines)]
    found = decode_traffic(VectorNavImu, "vectornav", {"baud": 115_200}, chunks)
    assert found is not None
    assert (found.messages, found.samples) == (20, 0)


@given(st.lists(st.tuples(st.integers(0, 2**64 - 1), st.integers(0, 10**12)), max_size=30))
def test_hostile_times_never_raise(content: list[tuple[int, int]]) -> None:
    decoder = VectorNavImu(settings()).decoder()
    t_ns = 0
    for device_ns, step_ns in content:
        t_ns += step_ns
        decoder.feed(Chunk(t_ns, output(device_ns) + b"$VNRRG,26,1,2*00\r\n"))
    decoder.flush()


@given(st.text("0123456789ABCDEFx,.-", max_size=40))
def test_hostile_registers_never_raise(text: str) -> None:
    for register in ("01", "26", "75", "76", "99", ""):
        decoded([encode_text(f"VNRRG,{register},{text}"), encode_text(f"VNERR,{text}")])


@pytest.mark.parametrize(("period", "warned"), [(1, False), (2, True)])
def test_a_device_whose_imu_has_another_rate_is_reported(period: int, *, warned: bool) -> None:
    register = encode_text("VNRRG,75,3,8,01,0011")
    stream = [output(k * period * PERIOD_NS) for k in range(40) if k % 9]  # every ninth is lost
    warnings = events_of(decoded([register, *stream]), "warning")
    assert [one.data for one in warnings] == [{"rate_hz": 50.0}] * warned
    assert all("rate_hz = 50" in one.text and "800" in one.text for one in warnings)
