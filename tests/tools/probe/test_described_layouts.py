"""`jointfit probe` recognizes devices by the frame layouts in a rig.toml."""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.files.captures import pack_can_frame
from jointfit_daemon.model import Chunk
from jointfit_daemon.tools.discovery import decode_frames, decode_stream
from jointfit_daemon.tools.probe._described_layouts import described_layouts

if TYPE_CHECKING:
    from pathlib import Path

RIG = """
[[imu]]
id = "S1"
driver = "serial-table"
port = "/dev/ttyUSB0"
text = { prefix = "$Q,", columns = 4 }
fields.quaternion = { column = 1 }
[[imu]]
id = "S2"
driver = "serial-table"
port = "/dev/ttyUSB1"
text = { prefix = "$Q,", columns = 4 }
fields.quaternion = { column = 1 }
[[imu]]
id = "S3"
driver = "can-table"
can = "can0"
ids = { quaternion = 0x131 }
fields.quaternion = { offset = 0, type = "i16", divisor = 32767 }
[[imu]]
id = "S4"
driver = "xbus"
port = "/dev/ttyUSB2"
"""
PERIOD_NS = 10_000_000


def test_the_layouts_of_a_rig_are_listed_once_without_connections(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    found = described_layouts(rig)
    assert {name: len(tables) for name, tables in found.items()} == {
        "serial-table": 1, "can-table": 1,
    }  # fmt: skip
    assert set(found["serial-table"][0]) == {"text", "fields"}


@pytest.mark.parametrize("text", [None, "[[imu", "imu = 5", "[[imu]]\nfields = 3"])
def test_a_rig_that_cannot_be_read_has_no_layouts(tmp_path: Path, text: str | None) -> None:
    rig = tmp_path / "rig.toml"
    if text is not None:
        rig.write_text(text)
    assert described_layouts(rig) == {}


def test_lines_and_frames_are_recognized_by_the_layout_of_the_rig(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    layouts = described_layouts(rig)
    lines = [Chunk(k * PERIOD_NS, b"$Q,1.0,0.0,0.0,0.0\r\n") for k in range(50)]
    (board,) = (each for each in decode_stream(lines, 115_200, layouts=layouts) if each.samples)
    assert (board.driver, board.usual_rate_hz) == ("serial-table", 100)
    assert decode_stream(lines, 115_200) == ()

    data = struct.pack("<4h", 32767, 0, 0, 0)
    frames = [Chunk(k * PERIOD_NS, pack_can_frame(k * PERIOD_NS, 0x131, data)) for k in range(50)]
    sizes = {(0x131, False): 8}
    (sensor,) = decode_frames(sizes, frames, layouts=layouts)
    assert (sensor.driver, sensor.settings["ids"]) == ("can-table", {"quaternion": 0x131})
    assert list(decode_frames(sizes, frames)) == []
