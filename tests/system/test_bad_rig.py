"""Invalid rig.toml: the daemon process reports all mistakes together and does not start."""

from __future__ import annotations

import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from pathlib import Path

pytestmark = pytest.mark.system

MISTAKES = """
[rig]
name = "a/b"
output_rate_hz = -5
[chain]
joints = ["hip", "knee"]
segments = ["thigh", "shank"]
[[imu]]
id = "S1"
segment = "thihg"
driver = "xbuss"
port = "/dev/ttyUSB0"
[[imu]]
id = "S2"
segment = "shank"
driver = "xcdi"
can = "can1"
ids = { quaternion = 0x121 }
[[imu]]
id = "S3"
segment = "thigh"
driver = "xcdi"
can = "can0"
ids = { sample_time = 0x105, group_counter = 0x106, quaternion = 0x121 }
[[imu]]
id = "S4"
segment = "shank"
driver = "xcdi"
can = "can0"
ids = { sample_time = 0x111, group_counter = 0x112, quaternion = 0x121 }
[can.can0]
channel = "can0"
[mocap]
driver = "natnet"
server = "127.0.0.1"
markers.thigh = ["T1", "T2"]
markers.shank = ["C1", "C2", "T1"]
[mqtt]
prot = 1883
[recodring]
"""
EXPECTED = (
    ("rig.name", "must not contain /"),
    ("rig.output_rate_hz", "greater than"),
    ("chain.joints", "expected 3 joints, one more than segments"),
    ("imu[S1].segment", "did you mean 'thigh'?"),
    ("imu[S1].driver", "did you mean 'xbus'?"),
    ("imu[S2].can", "no table [can.can1]", "can0"),
    ("imu[S4].ids.quaternion", "0x121", "belongs to S3 (quaternion)"),
    ("mocap.markers.thigh", "at least three different markers"),
    ("mocap.markers.shank", "is a marker of 'thigh' already"),
    ("mqtt.prot", "did you mean 'port'?"),
    ("recodring", "did you mean 'recording'?"),
)
"""Key and parts of the message of each mistake."""

TWINS = """
[rig]
name = "twins"
[chain]
joints = ["hip", "knee", "ankle"]
segments = ["thigh", "shank"]
[[imu]]
id = "S1"
segment = "thigh"
driver = "xcdi"
can = "can0"
ids = { sample_time = 0x105, group_counter = 0x106, quaternion = 0x121 }
[[imu]]
id = "S2"
segment = "shank"
driver = "xcdi"
can = "can0"
ids = { sample_time = 0x105, group_counter = 0x206, quaternion = 0x221 }
[can.can0]
channel = "can0"
"""


def start_daemon(folder: Path, text: str) -> subprocess.CompletedProcess[str]:
    rig = folder / "rig.toml"
    rig.write_text(text, encoding="utf-8")
    command = [sys.executable, "-m", "jointfit_daemon", "--config", str(rig)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_all_mistakes_of_a_rig_are_reported_together_and_the_daemon_does_not_start(
    tmp_path: Path,
) -> None:
    ended = start_daemon(tmp_path, MISTAKES)
    assert ended.returncode == 2
    assert ended.stdout == ""
    lines = ended.stderr.splitlines()
    for key, *parts in EXPECTED:
        assert any(key in line and all(part in line for part in parts) for line in lines), (
            key, parts, ended.stderr,
        )  # fmt: skip
    assert "Traceback" not in ended.stderr
    assert "running" not in ended.stderr
    assert not (tmp_path / "state").exists()


def test_two_sensors_with_one_can_identifier_are_rejected_before_a_port_is_opened(
    tmp_path: Path,
) -> None:
    ended = start_daemon(tmp_path, TWINS)
    assert ended.returncode == 2
    assert "imu[S2].ids.sample_time" in ended.stderr
    assert "0x105 on this bus belongs to S1 (sample_time)" in ended.stderr
