"""A sensor whose serial number differs from that of the calibrated sensor is reported."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.config import load_rig
from jointfit_daemon.model import Chunk, DeviceEvent
from jointfit_daemon.pipeline.sources._source_state import SourceState
from jointfit_protocols.ximu3 import encode_command
from tests.tools.calibrate_sensor.moved_device import RIG

if TYPE_CHECKING:
    from pathlib import Path

TABLE = """
[imu.sensor_calibration]
date = "2026-11-23"
serial = "0123ABCD"
gyroscope_bias_deg_s = [0.1, 0.2, 0.3]

# the second"""


@pytest.mark.parametrize(("serial", "warned"), [("0123ABCD", False), ("77777777", True)])
def test_only_another_serial_number_causes_a_warning(
    tmp_path: Path, serial: str, warned: bool
) -> None:
    rig = tmp_path / "rig.toml"
    text = RIG.format(port="/dev/ttyUSB0").replace("\n# the second", TABLE)
    rig.write_text(text, encoding="utf-8")
    state = SourceState.create(load_rig(rig).sources[0])
    state.start()
    reply = encode_command("ping", {"interface": "USB", "name": "x", "sn": serial})
    items = state.feed(Chunk(0, reply))
    warnings = [e.text for e in items if isinstance(e, DeviceEvent) and e.kind == "warning"]
    assert bool(warnings) is warned
    if warned:
        assert "the sensor has serial number 77777777, but its sensor_calibration" in warnings[0]
