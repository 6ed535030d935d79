"""A rig of four boards that only tables describe meets the targets of the demo."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.demo._command import _run, missed_targets

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(600)]

FAMILIES = {"S1": "serial-table", "S2": "can-table", "S3": "serial-table", "S4": "can-table"}


async def test_four_boards_described_by_tables_meet_the_targets_of_the_demo(tmp_path: Path) -> None:
    pytest.importorskip("iotcore")
    options = [word for name, driver in FAMILIES.items() for word in ("--imu", f"{name}={driver}")]
    figures, stopped = await _run(tmp_path, 8.0, "leg", options, headless=True, picture=None)
    assert stopped is None
    # Other experiments run at the same time, and another test tests the latency.
    assert [text for text in missed_targets(figures) if not text.startswith("latency")] == []
    assert figures["corrupt"] == 0
    rig = (tmp_path / "rig.toml").read_text(encoding="utf-8")
    assert [rig.count(f'driver = "{name}"') for name in ("serial-table", "can-table")] == [2, 2]
