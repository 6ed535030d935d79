"""No mistake in rig.toml hides another: all pairs of mistakes in different keys."""

from __future__ import annotations

import os
from functools import cache
from importlib.metadata import entry_points
from itertools import combinations
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.config import ConfigError, load_rig

if TYPE_CHECKING:
    from pathlib import Path

RIG = """
[rig]
name = "bench"
output_rate_hz = 100
align_mode = "smooth"
[chain]
joints = ["hip", "knee", "ankle"]
segments = ["thigh", "shank"]
side = "right"
proximal = "pelvis"
lengths_m = { thigh = 0.42 }
angles = { knee = "flexion" }
[[imu]]
id = "S1"
segment = "thigh"
driver = "xbus"
port = "/dev/ttyUSB0"
baud = 115200
orientation = "device"
silence_s = 1.0
[[imu]]
id = "S3"
segment = "shank"
driver = "xcdi"
can = "can1"
byte_order = "big"
[[imu]]
id = "S4"
segment = "shank"
driver = "xcdi"
can = "can1"
lag_sd_ms = 0.1
ids = { sample_time = 0x105, group_counter = 0x106, quaternion = 0x121 }
[can.can1]
interface = "socketcan"
channel = "can0"
bitrate = 500000
[calibration]
store = "default"
method = "anchored"
functional_s = 60
static_s = 5
joint_center_methods = { knee = "sara" }
[mqtt]
base = "jointfit/bench"
port = 1883
pose_ui_hz = 10
[mocap]
driver = "natnet"
server = "192.168.1.20"
up_axis = "y"
markers.thigh = ["T1", "T2", "T3"]
markers.shank = ["C1", "C2", "C3"]
rigid_body = { pelvis = "Pelvis" }
"""
SECOND_USER_OF_THE_PORT = """
[[imu]]
id='S5'
segment='shank'
driver='xbus'
port="/dev/ttyUSB0"
"""
MISTAKES = (
    ("[can.can1]\n", f"{SECOND_USER_OF_THE_PORT}[can.can1]\n", "is the port of imu["),
    ('"bench"\noutput', '"ben+ch"\noutput', "rig.name = 'ben+ch'"),
    ("rate_hz = 100", 'rate_hz = "fast"', "rig.output_rate_hz"),
    ("align_mode", "aling_mode", "did you mean 'align_mode'?"),
    ('"knee", "ankle"]', '"knee"]', "expected 3 joints"),
    ('["thigh", "shank"]\nside', '["thigh" "shank"]\nside', "unclosed array"),
    ('side = "right"', 'side = "middle"', "chain.side"),
    ('"pelvis"\n', '"shank"\n', "chain.proximal = 'shank': is already"),
    ("{ thigh = 0.42 }", "{ thihg = 0.42 }", "chain.lengths_m.thihg"),
    ("{ thigh = 0.42 }", "{ thigh = 420 }", "expected a length in metres"),
    ('{ knee = "flexion" }', '{ kne = "flexion" }', "chain.angles.kne"),
    ('id = "S1"', 'id = "mocap"', "is reserved"),
    ('driver = "xbus"', 'driver = "xbuss"', "did you mean 'xbus'?"),
    ('"/dev/ttyUSB0"', '""', "port = ''"),
    ("baud = 115200", "baud = 9600", "100 Hz need 36000 bit/s"),
    ('orientation = "device"', 'orientation = "devise"', "did you mean 'device'?"),
    ("orientation =", "orientaton =", "did you mean 'orientation'?"),
    ("silence_s = 1.0", "silence_s = inf", "silence_s = inf"),
    ('"thigh"\ndriver', "\"thigh\"\nsync = [{ functoin = 'send_latest' }]\ndriver",
     "did you mean 'function'?"),
    ('"thigh"\ndriver', "\"thigh\"\nsync = [{ function = 'send_latest', line = 'out1' }]\ndriver",
     "sync[0].line = 'out1'"),
    ('"shank"\ndriver = "xcdi"\ncan = "can1"\nb', '"shnak"\ndriver = "xcdi"\ncan = "can1"\nb',
     "imu[S3].segment = 'shnak'"),
    ('= "big"', "= big", "or a text in quotation marks"),
    ("lag_sd_ms = 0.1", "lag_sd_ms = 0,1", "use a decimal point"),
    ("sample_time = 0x105", "sample_time = 0x106", "each identifier once"),
    ("quaternion = 0x121", "quaternion = 0x921", "above 0x7FF"),
    ("quaternion = 0x121", "quaternion = 0x21", "id 0x21 on this bus belongs to S3"),
    ('"socketcan"', '"sockettcan"', "did you mean 'socketcan'?"),
    ('"can0"', '"can 0"', "can.can1.channel = 'can 0'"),
    ("bitrate = 500000", "bitrate = 50000", "the bus carries only 50000"),
    ("bitrate = 500000", "bitrate = 500000\nlocal_lopback = true", "did you mean 'local_loopback'"),
    ('"default"', '"../else"', "must be the plain name"),
    ('"anchored"', '"patent21"', "calibration.method"),
    ("functional_s = 60", "functional_s = 10", "is shorter than functional_min_s"),
    ("static_s = 5", "static_s = 500", "calibration.static_s"),
    ("[calibration]\n", "[calibration]\nchain_refinement = { threshold_mm = 20 }\n",
     "calibration.chain_refinement.threshold_mm = 20"),
    ("[calibration]\n", "[calibration]\nchain_refinement = { method = 'search', cost = 'l1' }\n",
     "method search has no loss function"),
    ('{ knee = "sara" }', '{ kene = "sara" }', "calibration.joint_center_methods.kene"),
    ('{ knee = "sara" }', '{ knee = "sarah" }', "calibration.joint_center_methods.knee"),
    ('"jointfit/bench"', '"jointfit//bench"', "mqtt.base"),
    ("port = 1883", "prot = 1883", "mqtt.prot"),
    ("pose_ui_hz = 10", 'pose_ui_hz = 10\nhost = "192.168.1.999"', "mqtt.host"),
    ('"192.168.1.20"', '"192.168.1.999"', "mocap.server"),
    ('up_axis = "y"', 'up_axis = "w"', "mocap.up_axis"),
    ('["T1", "T2", "T3"]', '["T1", 2, "T2"]', "mocap.markers.thigh[1]"),
    ('["C1", "C2", "C3"]', '["C1", "T1", "C1"]', "is a marker of 'thigh' already"),
    ('{ pelvis = "Pelvis" }', '{ foot = "Foot" }', "mocap.rigid_body.foot"),
    ("[mocap]\n", '[mqtt]\nusername = "x"\n[mocap]\n', "[mqtt] occurs a second time"),
    ("[calibration]\n", "[calibration\n", "close it with ]"),
    ("[calibration]\n", "[recodring]\n[calibration]\n", "did you mean 'recording'?"),
    ("up_axis", "upp_axis", "did you mean 'up_axis'?"),
)  # fmt: skip
"""Text of the rig, its replacement, and a part of the expected message."""

ALL = "JOINTFIT_ALL_PAIRS" in os.environ
"""Whether to try all pairs, which takes 4 s, instead of every third pair."""


@pytest.fixture(autouse=True)
def installed_drivers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read the metadata of all packages once instead of at every driver search (20 ms each)."""
    monkeypatch.setattr("jointfit_daemon.driver.entry_points", cache(entry_points))


def messages(folder: Path, text: str) -> str:
    path = folder / "rig.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_rig(path)
    return str(caught.value)


def test_the_rig_without_mistakes_is_valid(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(RIG, encoding="utf-8")
    load_rig(path)


def test_every_mistake_is_reported_alone(tmp_path: Path, subtests: pytest.Subtests) -> None:
    for old, new, expected in MISTAKES:
        with subtests.test(new):
            assert RIG.count(old) == 1
            found = messages(tmp_path, RIG.replace(old, new))
            assert expected in found
            assert "unreadable-line" not in found


UNREADABLE_SEGMENTS = "unclosed array"
"""Message of an unreadable list of segments. With this fault, messages that begin with a text in
`NEED_SEGMENTS` cannot be reported.
"""
NEED_SEGMENTS = (
    "chain.proximal = 'shank'", "chain.lengths_m.thihg", "imu[S3].segment = 'shnak'",
    "expected 3 joints", "calibration.joint_center_methods.kene", "mocap.rigid_body.foot",
)  # fmt: skip


def test_no_mistake_hides_another(tmp_path: Path) -> None:
    hidden = []
    for first, second in [*combinations(MISTAKES, 2)][:: 1 if ALL else 3]:
        changed = RIG.replace(first[0], first[1])
        if changed.count(second[0]) != 1 or first[0] in second[0] or second[0] in first[0]:
            continue  # both mistakes concern the same key
        found = messages(tmp_path, changed.replace(second[0], second[1]))
        missing = [text for text in (first[2], second[2]) if text not in found]
        if UNREADABLE_SEGMENTS in (first[2], second[2]):
            missing = [text for text in missing if not text.startswith(NEED_SEGMENTS)]
        hidden += [(first[1], second[1], text) for text in missing]
    assert hidden == []
