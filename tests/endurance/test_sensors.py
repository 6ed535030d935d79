"""The sensors of the endurance run send every due sample once, or report a machine too slow."""

from __future__ import annotations

import math
import os
import select
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_protocols.xbus import XbusCodec, XbusMessage
from jointfit_protocols.xbus.configuration import TICK_NS
from jointfit_protocols.xbus.mtdata2 import Item, decode_item, split
from tests.endurance.sensors import (
    BATCH,
    PERIOD_NS,
    SENSORS,
    SLOW_WAKES,
    Movement,
    Sensors,
    TooSlowError,
)

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def sensors(tmp_path: Path) -> Iterator[Sensors]:
    made = Sensors(tmp_path, Movement(12))
    for device in made.devices:
        device.streaming = True
    yield made
    for device in made.devices:
        device.unplug()


@pytest.fixture
def lines(sensors: Sensors, tmp_path: Path) -> Iterator[list[int]]:
    del sensors  # this fixture creates the lines
    opened = [os.open(tmp_path / name, os.O_RDWR | os.O_NOCTTY) for name in SENSORS]
    yield opened
    for fd in opened:
        os.close(fd)


def samples_on(line: int) -> list[dict[int, Any]]:
    """Return the items of all messages on a line."""
    data = b""
    while select.select([line], [], [], 0.05)[0]:  # until the kernel delivers no more
        data += os.read(line, 65536)
    return [
        {data_id & 0xFFF0: decode_item(data_id, raw) for data_id, raw in split(message.data) or []}
        for message in XbusCodec().feed(data)
        if isinstance(message, XbusMessage)
    ]


def test_every_line_carries_every_due_sample_once(sensors: Sensors, lines: list[int]) -> None:
    for due in (3, 3, 7):
        sensors.send_until(due)
    for line in lines:
        found = samples_on(line)
        assert [sample[Item.PACKET_COUNTER] for sample in found] == [1, 2, 3, 4, 5, 6, 7]
        for number, sample in enumerate(found, 1):
            assert sample[Item.SAMPLE_TIME_FINE] == number * PERIOD_NS // TICK_NS
            half = sensors.movement.angle(number * PERIOD_NS) / 2
            turned = (math.cos(half), math.sin(half), 0.0, 0.0)
            assert sample[Item.QUATERNION] == pytest.approx(turned, abs=1e-6)


def test_a_sensor_that_is_not_in_measurement_mode_sends_nothing(
    sensors: Sensors, lines: list[int]
) -> None:
    sensors.devices[1].streaming = False
    sensors.send_until(5)
    assert [len(samples_on(line)) for line in lines] == [5, 0, 5, 5]


def test_samples_of_a_pause_of_the_machine_are_skipped(sensors: Sensors, lines: list[int]) -> None:
    sensors.send_until(2)
    sensors.send_until(10_000 + BATCH)
    counters = [sample[Item.PACKET_COUNTER] for sample in samples_on(lines[0])]
    assert counters[:4] == [1, 2, 10_001, 10_002]
    assert sensors.skipped == 10_000 - 2


def test_pauses_of_the_machine_are_no_error(sensors: Sensors) -> None:
    due = 0
    for _ in range(2 * SLOW_WAKES):
        sensors.send_until(due := due + 5000)
        sensors.send_until(due := due + 4)


def test_a_machine_too_slow_for_the_factor_is_an_error(sensors: Sensors) -> None:
    for wake in range(1, SLOW_WAKES):
        sensors.send_until(wake * (BATCH + 1))
    with pytest.raises(TooSlowError, match=r"too slow for --factor 12, choose a smaller one"):
        sensors.send_until(SLOW_WAKES * (BATCH + 1))
    assert sensors.skipped == SLOW_WAKES


def test_lines_that_nobody_reads_do_not_stop_the_sensors(sensors: Sensors) -> None:
    for wake in range(1, 31):
        sensors.send_until(wake * BATCH)
    assert sensors.number == 30 * BATCH


def test_the_process_reports_a_machine_too_slow_and_ends(tmp_path: Path) -> None:
    words = [str(tmp_path), "1000000", str(time.monotonic_ns())]
    ended = subprocess.run(
        [sys.executable, "-m", "tests.endurance.sensors", *words],
        capture_output=True, text=True, check=False, timeout=30,
    )  # fmt: skip
    assert ended.returncode == 1
    assert "too slow for --factor 1000000, choose a smaller one" in ended.stderr
    assert "Traceback" not in ended.stderr


@pytest.mark.parametrize("option", ["samples", "factor", "minutes"])
def test_a_quantity_of_zero_is_refused_before_anything_starts(option: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.endurance", f"--{option}", "0"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 2
    assert f"--{option}: expected a number above 0" in done.stderr
