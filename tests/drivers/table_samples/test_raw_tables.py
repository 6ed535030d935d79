"""Orientations of raw readings that a table describes, with and without device time."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.driver import CanBusSettings, find_driver
from jointfit_daemon.model import Chunk, Corrupt, DeviceEvent, ImuSample
from jointfit_protocols.can import CanFrame, pack_frames
from jointfit_protocols.table import LineFormat, encode_can_frames, encode_line
from jointfit_simulators.devices import TableDevice
from tests.drivers.self_described import device_options, serial_settings
from tests.drivers.table_samples.test_fitting_settings import MemoryPort

if TYPE_CHECKING:
    from jointfit_simulators.imu_device import Quaternion

pytest.importorskip("vqf")

PERIOD_NS = 10_000_000
CSV: dict[str, Any] = {
    "text": {"columns": 10},
    "orientation": "gateway",
    "settle_s": 0.5,
    "fields": {
        "time": {"column": 1, "unit": "us"},
        "acceleration": {"column": 2, "unit": "g"},
        "rate": {"column": 5, "unit": "deg/s"},
        "magnetic": {"column": 8},
    },
}
NODE: dict[str, Any] = {
    "ids": {"gyro": 0x110, "accel": 0x111},
    "orientation": "gateway",
    "settle_s": 0.5,
    "fields": {
        "rate": {"frame": "gyro", "offset": 0, "type": "i16", "divisor": 16.4, "unit": "deg/s"},
        "acceleration": {
            "frame": "accel",
            "offset": 0,
            "type": "i16",
            "divisor": 4096,
            "unit": "g",
        },
    },
}


def turning(number: int) -> Quaternion:
    """Return the true orientation at reading `number`: rest for 2 s, then oscillation about x."""
    roll = 0.6 * math.sin(2.0 * max(number - 200, 0) * 0.01)
    return (math.cos(roll / 2), math.sin(roll / 2), 0.0, 0.0)


def inclination_error_deg(sample: ImuSample, number: int) -> float:
    """Return the angle between the estimated and the true vertical in sensor axes."""

    def up(q: Quaternion) -> tuple[float, float, float]:
        w, x, y, z = q
        return (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))

    cosine = sum(a * b for a, b in zip(up(sample.q_world_sensor), up(turning(number)), strict=True))
    return math.degrees(math.acos(min(1.0, cosine)))


def lines(settings: Any, count: int) -> list[bytes]:
    port = MemoryPort(settings)
    device = TableDevice(port, device_options(settings))
    for number in range(count):
        device.push(number * PERIOD_NS, turning(number))
    return port.messages


def test_lines_of_an_arduino_with_raw_readings_become_orientations() -> None:
    settings = serial_settings("/dev/ttyUSB0", CSV)
    decoder = find_driver("serial-table")(settings).decoder()
    samples: dict[int, ImuSample] = {}
    events: list[DeviceEvent] = []
    for number, line in enumerate(lines(settings, 800)):
        for item in decoder.feed(Chunk((1 + number) * PERIOD_NS, line)):
            assert not isinstance(item, Corrupt), item
            if isinstance(item, ImuSample):
                samples[number] = item
            elif isinstance(item, DeviceEvent):
                events.append(item)
    assert len(samples) > 700
    assert max(inclination_error_deg(each, number) for number, each in samples.items()) < 1.5
    assert samples[500].acceleration is not None
    assert math.hypot(*samples[500].acceleration) == pytest.approx(9.81, abs=0.01)
    assert [event.text for event in events if "fields." in event.text] == []
    assert any("orientation_filter" in event.data for event in events)


def test_a_node_without_time_uses_the_stamps_of_the_bus() -> None:
    bus = CanBusSettings(interface="virtual", channel="raw")
    driver = find_driver("can-table")
    settings = driver.Settings.model_validate(
        {"id": "S1", "segment": "thigh", "driver": "can-table", "can": bus} | NODE
    )
    device = TableDevice(MemoryPort(serial_settings("/dev/x", CSV)), device_options(settings))
    decoder, table = driver(settings).decoder(), settings.can_table()
    found = 0
    for number in range(600):
        t_ns = (7 + number) * PERIOD_NS
        device._inertial.update(number * PERIOD_NS, turning(number))
        values = device.record(number * PERIOD_NS, turning(number))
        frames = [
            CanFrame(t_ns, key[0], data, key[1]) for key, data in encode_can_frames(table, values)
        ]
        for item in decoder.feed(Chunk(t_ns, pack_frames(frames))):
            if isinstance(item, ImuSample):
                found += 1
                assert item.ticks is None
                assert inclination_error_deg(item, number) < 1.5
    assert found > 500


def test_readings_of_one_instant_and_saturated_ones_are_noticed() -> None:
    settings = serial_settings("/dev/ttyUSB0", CSV)
    decoder = find_driver("serial-table")(settings).decoder()
    wire = settings.wire_format()
    assert isinstance(wire, LineFormat)
    out: list[Any] = []
    for number in range(120):
        micros = 10_000 * (number - (number == 100))
        line = encode_line(wire, [0, 0, 500.0 if number > 110 else 0, 0, 0, 1, 0, 1, 0, micros])
        out += decoder.feed(Chunk((1 + number) * PERIOD_NS, line))
    assert [item.reason for item in out if isinstance(item, Corrupt)] == [
        "raw measurements out of range, or with the time of the previous ones"
    ]
    assert any("out of range: heading is uncertain" in getattr(item, "text", "") for item in out)


def test_raw_readings_without_time_need_it_on_a_serial_port() -> None:
    """On a serial port, a table of raw readings must have a time field."""
    fields = {name: keys for name, keys in CSV["fields"].items() if name != "time"}
    with pytest.raises(ValueError, match=r"send micros\(\) or millis\(\) with each sample"):
        serial_settings("/dev/ttyUSB0", CSV | {"fields": fields})
    without = {name: keys for name, keys in CSV["fields"].items() if name != "magnetic"}
    with pytest.raises(ValueError, match="add it, or remove `magnetometer`"):
        serial_settings("/dev/ttyUSB0", CSV | {"fields": without, "magnetometer": True})
