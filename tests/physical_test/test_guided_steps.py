"""The steps of a physical test, and the settings that it proposes, with a fake sensor."""

from __future__ import annotations

import pytest

from jointfit_daemon.physical_test import STEPS, PhysicalTest, correction_lines
from tests.physical_test.turned_sensor import guided_chunks, guided_poses, turned_source


def complete(test: PhysicalTest) -> PhysicalTest:
    test.begin()
    for chunk in guided_chunks():
        test.add(chunk)
    return test


def test_each_rest_ends_a_step_and_the_instruction_names_the_sensor() -> None:
    test = PhysicalTest(turned_source())
    assert test.instruction == STEPS[0].format(id="S1")
    assert not test.has_orientation
    assert len(complete(test).rests) == len(STEPS)
    assert test.instruction is None


def test_a_rest_before_the_first_instruction_does_not_count() -> None:
    test = PhysicalTest(turned_source())
    for chunk in guided_chunks(guided_poses()[:1]):
        test.add(chunk)
    assert test.has_orientation
    assert test.rests == []


@pytest.mark.parametrize(
    ("configured", "correction"),
    [("sensor_to_world", ()), ("world_to_sensor", ('direction = "sensor_to_world"',))],
)
def test_the_setting_that_agrees_with_the_movement_is_found(
    configured: str, correction: tuple[str, ...]
) -> None:
    result = complete(PhysicalTest(turned_source(configured))).result()
    assert result.rig_toml == correction
    assert result.agrees is not bool(correction)
    lines = list(correction_lines(result))
    assert lines[0] == ("S1: not as configured" if correction else
                        "S1: world, axes and direction are as configured")  # fmt: skip
    assert lines[1:] == [f"in its [[imu]] table of rig.toml:\n{text}" for text in correction]
