"""A rig of four IMU families meets the targets of the demo with each family of cameras.

Each run takes more than a minute of real time, so CI runs only one of them. `make test-cameras`
runs all.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.tools.demo._command import _run, missed_targets

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = [pytest.mark.system, pytest.mark.experiment, pytest.mark.timeout(300)]

# Two sensors use UARTs, and two use CAN. Drivers discard data that a device sends before the first
# reply of its handshake. These devices lose no sample in this way: they send nothing before the
# handshake, or have no handshake.
FAMILIES = {"S1": "bno085", "S2": "lpms-can", "S3": "serial-table", "S4": "can-table"}


CAMERAS = ["natnet", "qtm", "vicon", "vrpn"] if os.environ.get("JOINTFIT_ALL_CAMERAS") else ["qtm"]


@pytest.mark.parametrize("cameras", CAMERAS)
async def test_four_families_meet_the_targets_of_the_demo_with_each_camera_system(
    tmp_path: Path, cameras: str
) -> None:
    pytest.importorskip("iotcore")
    options = [word for name, driver in FAMILIES.items() for word in ("--imu", f"{name}={driver}")]
    options += ["--mocap", cameras]
    figures, stopped = await _run(tmp_path, 8.0, "leg", options, headless=True, picture=None)
    assert stopped is None
    # Other experiments run at the same time; tests/system/test_timing_end_to_end.py tests latency.
    assert [text for text in missed_targets(figures) if not text.startswith("latency")] == []
    assert figures["corrupt"] == 0
    rig = (tmp_path / "rig.toml").read_text(encoding="utf-8")
    for driver in (*FAMILIES.values(), cameras):
        assert rig.count(f'driver = "{driver}"') == 1
