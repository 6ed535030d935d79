"""`jointfit probe --physical-test`: a turned sensor shows which settings are wrong."""

from __future__ import annotations

import asyncio
import sys
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner

from jointfit_daemon.config import load_rig
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.probe._physical_test import PhysicalTestError, run_physical_test
from tests.physical_test.turning_hand import RIG, held

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.real_time


@pytest.mark.parametrize(
    ("world", "inverse", "correction"),
    [
        ("ENU", False, ()),
        ("ENU", True, ('direction = "world_to_sensor"',)),
        ("NED", False, ('world = "NED"',)),
    ],
)
async def test_wrong_settings_are_found_and_corrected(
    tmp_path: Path, world: str, inverse: bool, correction: tuple[str, ...]
) -> None:
    async with held(tmp_path, world=world, world_to_sensor=inverse) as hand:
        source = load_rig(tmp_path / "rig.toml").sources[0]
        result = await run_physical_test(source, hand.follow, step_s=20.0)
    assert result.agrees is not bool(correction)
    assert result.rig_toml == correction
    largest_deg = max(result.deviations_deg)
    assert largest_deg > 85.0 if correction else largest_deg < 5.0


async def test_the_command_guides_and_ends_with_the_lines_to_paste(tmp_path: Path) -> None:
    async with held(tmp_path, world_to_sensor=True) as hand:
        command = ["-m", "jointfit_daemon.tools", "probe", "--physical-test", "S1", "--step", "20"]
        process = await asyncio.create_subprocess_exec(
            sys.executable, "-u", *command, "--config", str(tmp_path / "rig.toml"),
            stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        assert process.stdout is not None
        lines = []
        async for line in process.stdout:
            lines.append(line.decode())
            hand.follow(lines[-1])
        code = await process.wait()
    text = "".join(lines)
    assert code == 1
    assert text.startswith("Opening S1 …\nLay S1 flat, its z axis up, and let go.\nTurn it")
    assert "S1 sends: components w x y z, world to sensor" in text
    assert 'in its [[imu]] table of rig.toml:\ndirection = "world_to_sensor"' in text


async def test_a_sensor_that_is_not_turned_ends_the_test_in_words(tmp_path: Path) -> None:
    async with held(tmp_path):
        source = load_rig(tmp_path / "rig.toml").sources[0]
        with pytest.raises(PhysicalTestError, match="S1: no rest in a new orientation within 4 s"):
            await run_physical_test(source, lambda _: None, step_s=4.0)


async def test_a_device_that_is_absent_is_reported_before_any_instruction(tmp_path: Path) -> None:
    async with held(tmp_path):
        absent = load_rig(tmp_path / "rig.toml").sources[1]
        lines: list[str] = []
        with pytest.raises(PhysicalTestError, match=r"S2: .*is not there"):
            await run_physical_test(absent, lines.append, step_s=20.0)
    assert lines == ["Opening S2 …"]


def test_an_unknown_sensor_and_other_devices_are_refused(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text(
        RIG + '[[imu]]\nid = "S1"\nsegment = "thigh"\ndriver = "xbus"\nport = "/dev/null"\n'
        '[[imu]]\nid = "S2"\nsegment = "shank"\ndriver = "xbus"\nport = "/dev/zero"\n'
    )
    command = ["probe", "--config", str(tmp_path / "rig.toml"), "--physical-test"]
    unknown = CliRunner().invoke(app, [*command, "S7"])
    assert unknown.exit_code == 2
    assert "no sensor 'S7'; did you mean 'S2'? known: S1, S2" in unknown.output
    both = CliRunner().invoke(app, [*command, "S1", "--serial", "/dev/null"])
    assert "--physical-test takes the port from rig.toml" in both.output
