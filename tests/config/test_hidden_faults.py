"""A fault of rig.toml hides no other fault, and its message contains no internal values."""

from __future__ import annotations

import tomllib
from typing import TYPE_CHECKING, Any

import orjson
import pytest
from typer.testing import CliRunner

from jointfit_daemon.config import ConfigError, missing_files, parse_rig, rig_warnings
from jointfit_daemon.driver import find_driver
from jointfit_daemon.tools.__main__ import app

if TYPE_CHECKING:
    from pathlib import Path

RIG = """
[rig]
name = "bench"
[chain]
joints = ["hip", "knee", "ankle"]
segments = ["thigh", "shank"]
[[imu]]
id = "S1"
segment = "thigh"
driver = "xbus"
port = "/dev/ttyUSB0"
[[imu]]
id = "S3"
segment = "shank"
driver = "xcdi"
can = "can1"
[[imu]]
id = "S4"
segment = "shank"
driver = "xcdi"
can = "can1"
ids = { sample_time = 0x105, group_counter = 0x106, quaternion = 0x121 }
[can.can1]
channel = "can0"
"""
MOCAP = '[mocap]\ndriver = "natnet"\nserver = "192.168.1.20"\n'


def complaints(text: str) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        parse_rig(tomllib.loads(text))
    return [fault.text() for fault in caught.value.faults]


def check(folder: Path, text: str, *options: str) -> Any:
    path = folder / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return CliRunner().invoke(app, ["check", str(path), *options])


def in_bus(text: str, keys: str) -> str:
    """Return `text` with `keys` as the content of the table [can.can1]."""
    return text.replace('[can.can1]\nchannel = "can0"\n', f"[can.can1]\n{keys}\n")


MISSPELLED = 'interface = "sockettcan"\nchannel = "can0"'


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (in_bus(RIG.replace("0x121", "0x921"), MISSPELLED),
         ["can.can1.interface = 'sockettcan': no CAN interface", "0x921 is above 0x7FF"]),
        (in_bus(RIG.replace("ids =", "# ids ="), MISSPELLED),
         ["can.can1.interface", "imu[S4].ids.sample_time: id 0x5", "imu[S4].ids.group_counter",
          "imu[S4].ids.quaternion", "imu[S4].ids.status_word", "imu[S4].ids.error"]),
        (in_bus(RIG, 'interface = "sockettcan"\nchannel = "can 0"'),
         ["can.can1.interface", "can.can1.channel = 'can 0': expected the name of a network"]),
        (in_bus(RIG, 'interface = "slcann"\nchannel = "/dev/ttyACM0"\nbitrate = 123456'),
         ["can.can1.interface", "can.can1.bitrate = 123456: not a bit rate of SLCAN"]),
        (in_bus(RIG, 'interface = "slcann"\nchannel = "/dev/ttyACM0"'), ["did you mean 'slcan'?"]),
        (in_bus(RIG, 'interface = "x"\nchannel = "/dev/x"\nbitrate = 123456'),
         ["can.can1.interface"]),
    ],
)  # fmt: skip
def test_a_misspelled_interface_is_one_fault_and_hides_no_other(
    text: str, expected: list[str]
) -> None:
    found = complaints(text)
    assert len(found) == len(expected), found
    for part in expected:
        assert any(part in line for line in found), found


def test_an_empty_port_does_not_hide_an_insufficient_bit_rate() -> None:
    found = complaints(RIG.replace('"/dev/ttyUSB0"', '""\nbaud = 9600'))
    assert [line.split(":")[0] for line in found] == ["imu[S1].port = ''", "imu[S1].baud = 9600"]


@pytest.mark.parametrize("wrong", ["rate_hz = 99.5", 'transport = "usbb"', "bawd = 921600"])
def test_the_load_is_not_checked_while_a_key_that_changes_it_is_wrong(wrong: str) -> None:
    assert len(complaints(RIG.replace('"/dev/ttyUSB0"', f'"/dev/a"\nbaud = 9600\n{wrong}'))) == 1


@pytest.mark.parametrize("wrong", ["silence_s = -1", "lag_sd_ms = 0", "colour = 3"])
def test_a_fault_that_does_not_change_the_load_does_not_hide_it(wrong: str) -> None:
    slow = RIG.replace('"/dev/ttyUSB0"', f'"/dev/a"\nbaud = 9600\n{wrong}')
    assert [line.split(" =")[0] for line in complaints(slow)] == [
        f"imu[S1].{wrong.partition(' ')[0]}",
        "imu[S1].baud",
    ]
    full = in_bus(RIG, 'channel = "can0"\nbitrate = 50000').replace(
        'can = "can1"\n', f'can = "can1"\n{wrong}\n', 1
    )
    bus = [line for line in complaints(full) if line.startswith("can.can1.bitrate")]
    assert bus[0].startswith("can.can1.bitrate = 50000: S3, S4 need"), bus


def test_a_sensor_without_a_valid_id_is_named_by_its_place_everywhere() -> None:
    text = RIG.replace('id = "S1"\n', "").replace('"/dev/ttyUSB0"', '"/dev/a"\nbaud = 9600')
    assert [line.split(":")[0] for line in complaints(text)] == [
        "imu[#1].id",
        "imu[#1].baud = 9600",
    ]
    assert complaints(RIG.replace("/dev/ttyUSB0", "a\\u0000b"))[0].startswith("imu[S1].port = ")


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (f"{RIG}[calibration]\nfunctional_s = 10\n",
         "calibration.functional_s = 10.0: is shorter than functional_min_s = 45"),
        (f'{RIG}[recording]\ndirectory = ""\n', "recording.directory = ''"),
        (RIG.replace("[[imu]]", "origin_m = [0, 0]\n[[imu]]", 1),
         "chain.origin_m[2]: missing: expected a value"),
    ],
)  # fmt: skip
def test_values_that_cannot_work_together_are_one_fault(text: str, line: str) -> None:
    (found,) = complaints(text)
    assert found.startswith(line)
    assert not found.endswith("; ")


SEVERAL = RIG.replace("ids = {", "# ids = {").replace('"/dev/ttyUSB0"', '"/dev/a"\nbaud = 9600')


@pytest.mark.parametrize(
    "wrong",
    [
        ('name = "bench"', "name = bench"),
        ('[rig]\n', '[rig\n'),
        ('[[imu]]\nid = "S1"', '[[imu]\nid = "S1"'),
        ('segments = ["thigh", "shank"]', 'segments = [\n  "thigh" "shank"\n]'),
        ('id = "S1"', "id = S1"),
        ('segment = "thigh"', 'segment = "thigh'),
    ],
)  # fmt: skip
def test_a_syntax_error_adds_one_fault_and_hides_none(
    tmp_path: Path, wrong: tuple[str, str]
) -> None:
    text = f'{SEVERAL}[mqtt]\npassword = "secret"\n'
    expected = complaints(text)
    assert any("id 0x5 on this bus" in line for line in expected)
    assert wrong[0] in text
    shown = check(tmp_path, text.replace(*wrong, 1), "--json")
    faults = orjson.loads(shown.stdout)["faults"]
    assert faults[0]["key"].startswith("line ")
    assert [fault["key"].replace("#1", "S1") for fault in faults[1:]] == [
        line.split(":")[0].split(" =")[0] for line in expected
    ]


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        ('interface = "vector"\nchannel = "0"', "can.can1.interface = 'vector': CAN interface"),
        ('interface = "socketcand"\nchannel = "can0"\nport = 29536', "can.can1.host: missing"),
        ('interface = "udp_multicast"\nchannel = "can0"', "can.can1.channel = 'can0': expected a"),
    ],
)
def test_a_bus_that_cannot_be_opened_here_is_one_fault(keys: str, line: str) -> None:
    (found,) = complaints(in_bus(RIG, keys))
    assert found.startswith(line)


def test_a_network_bus_with_its_keys_is_valid() -> None:
    keys = 'interface = "socketcand"\nchannel = "can0"\nhost = "192.168.1.5"\nport = 29536'
    parse_rig(tomllib.loads(in_bus(RIG, keys)))
    parse_rig(tomllib.loads(in_bus(RIG, 'interface = "udp_multicast"\nchannel = "239.74.163.2"')))


def test_a_line_with_a_syntax_error_causes_no_fault_by_its_default(tmp_path: Path) -> None:
    (ids,) = [line for line in RIG.splitlines() if line.startswith("ids")]
    for wrong in (ids.removesuffix("}"), "bitrate 500000"):
        text = RIG.replace(ids, wrong) if wrong.startswith("ids") else f"{RIG}{wrong}\n"
        shown = orjson.loads(check(tmp_path, text, "--json").stdout)
        assert len(shown["faults"]) == 1, shown


def test_a_wrong_bit_rate_is_one_fault_and_its_bus_exists() -> None:
    found = complaints(in_bus(RIG, 'channel = "can 0"\nbitrate = 123'))
    assert [line.split(" =")[0] for line in found] == ["can.can1.channel", "can.can1.bitrate"]

    found = complaints(in_bus(RIG, 'channel = "can0"\nbitrate = 123').replace('"can1"', '"cam1"'))
    assert "no table [can.cam1]; known: can1; did you mean 'can1'?" in found[1] + found[2]


def test_a_wrong_bit_rate_does_not_hide_identifier_collisions() -> None:
    found = complaints(in_bus(RIG.replace("ids =", "# ids ="), 'channel = "can0"\nbitrate = 123'))
    assert any("imu[S4].ids.quaternion: id 0x21 on this bus belongs to S3" in s for s in found)


def test_sensors_on_different_missing_buses_are_not_compared() -> None:
    text = RIG.replace("ids =", "# ids =").replace('"can1"', '"a"', 1).replace('"can1"', '"b"')
    assert [line.split(" =")[0] for line in complaints(text)] == ["imu[S3].can", "imu[S4].can"]


def test_a_bus_without_sensors_is_checked() -> None:
    found = complaints(f'{RIG}[can.spare]\ninterface = "sockettcan"\nchannel = "can 0"\n')
    assert [line.split(" =")[0] for line in found] == ["can.spare.interface", "can.spare.channel"]


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (RIG + MOCAP.replace("192.168.1.20", ""), "mocap.server = '': expected one address"),
        (RIG + MOCAP.replace("192.168.1.20", "a b"), "mocap.server = 'a b': expected one address"),
        (f'{RIG}{MOCAP}plate = ""\n', "mocap.plate = '': "),
        (f'{RIG}[mqtt]\nhost = "a b"\ninsecure = true\n', "mqtt.host = 'a b': expected one add"),
        (RIG.replace("0x121", "0x921"),
         "imu[S4].extended_ids = false: ids.quaternion = 0x921 is above 0x7FF"),
        (RIG.replace("0x121", "0x106"), "imu[S4].ids: each identifier once: found 0x106"),
        (RIG.replace("{ sample_time = 0x105, group_counter = 0x106, quaternion = 0x121 }", '"a"'),
         "imu[S4].ids = 'a': expected a table, such as ids = { sample_time = 5 }"),
        (RIG.replace('"can1"', "3", 1), "imu[S3].can = 3: expected the name of a [can.NAME] table"),
    ],
)  # fmt: skip
def test_an_impossible_value_is_one_fault_in_plain_words(text: str, line: str) -> None:
    (found,) = complaints(text)
    assert found.startswith(line)
    assert "{'" not in found


def test_other_faults_of_a_sensor_do_not_hide_an_identifier_above_11_bits() -> None:
    found = complaints(RIG.replace("0x121 }", "0x921 }\nrate_hz = -1"))
    assert [line.split(" =")[0] for line in found] == ["imu[S4].rate_hz", "imu[S4].extended_ids"]


def test_faults_in_json_have_plain_values(tmp_path: Path) -> None:
    text = f"{RIG.replace('0x106', '-1')}[cann]\n"
    result = check(tmp_path, text, "--json")
    assert result.exit_code == 2
    assert "object at" not in result.stdout
    faults = {fault["key"]: fault for fault in orjson.loads(result.stdout)["faults"]}
    assert "value" not in faults["cann"]
    assert faults["cann"]["near"] == "can"
    assert faults["imu[S4].ids.group_counter"]["value"] == -1


def test_a_missing_file_is_a_warning_of_the_check(tmp_path: Path) -> None:
    (tmp_path / "ca.pem").touch()
    text = f'{RIG}[mqtt]\npassword_file = "nowhere"\n[mqtt.tls]\nca = "ca.pem"\n'
    result = check(tmp_path, text)
    assert result.exit_code == 0
    assert "no such file" in " ".join(result.stdout.split())
    (warning,) = orjson.loads(check(tmp_path, text, "--json").stdout)["warnings"]
    assert warning.startswith(f"mqtt.password_file = '{tmp_path}/nowhere': no such file")
    assert missing_files(parse_rig(tomllib.loads(RIG)).mqtt) == []


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ("", "its data are unused"),
        ('plate = "Plate"\n', "only its plate"),
        ('rigid_body.thigh = "T"\n', None),
        ('markers.thigh = ["A", "B", "C"]\n', None),
    ],
)
def test_cameras_that_measure_no_segment_are_a_warning_of_the_check(
    keys: str, words: str | None
) -> None:
    warnings = rig_warnings(parse_rig(tomllib.loads(RIG + MOCAP + keys)))
    assert [words in warning for warning in warnings if words] == [True] * (words is not None)
    assert bool(warnings) is bool(words)


def test_a_valid_bus_imports_drivers_in_use_only(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def find(name: str) -> Any:
        asked.append(name)
        return find_driver(name)

    monkeypatch.setattr("jointfit_daemon.config._bus_faults.find_driver", find)
    parse_rig(tomllib.loads(in_bus(RIG, 'interface = "socketcan"\nchannel = "can0"')))
    assert set(asked) <= {"xbus", "xcdi"}
    assert "xcdi" in asked


@pytest.mark.parametrize(
    ("wrong", "expected"),
    [
        (
            ('joints = ["hip", "knee", "ankle"]', 'joints = ["hip", "knee", "ankle"'),
            "unclosed array",
        ),
        (('id = "S1"', 'id = """S1'), "unterminated string"),
        (("[[imu]]", "[rig]\nname = 'b'\n[[imu]]"), "table [rig] occurs a second time"),
        (('name = "bench"', 'name = "bench"\nname = "b"'), "name occurs a second time"),
        (('name = "bench"', 'name = "bench"\naxis = [1 2]'), "rig.axis: unknown key"),
    ],
)
def test_no_syntax_error_hides_a_fault_or_shows_internals(
    tmp_path: Path, wrong: tuple[str, str], expected: str
) -> None:
    text = SEVERAL.replace(*wrong, 1)
    assert text != SEVERAL
    shown = check(tmp_path, text).stderr
    assert expected in shown
    for line in ("imu[S4].ids.quaternion", ".baud = 9600"):
        assert line in shown
    assert "unreadable" not in shown
    assert "('" not in shown


@pytest.mark.parametrize("repeated", [19, 20])
def test_as_many_repeated_keys_as_are_reported_hide_no_other_fault(
    tmp_path: Path, repeated: int
) -> None:
    line = 'name = "bench"\n'
    shown = check(tmp_path, SEVERAL.replace(line, line * (repeated + 1), 1)).stderr
    assert shown.count("name occurs a second time") == repeated
    assert "imu[S4].ids.quaternion" in shown


@pytest.mark.parametrize(
    ("keys", "line"),
    [
        (
            'interface = "serial"\nchannel = "/dev/a"\nbaudrate = 9600',
            "can.can1.baudrate = 9600:",
        ),
        ('interface = "slcan"\nchannel = "can0"', "can.can1.channel = 'can0': expected the path"),
        ('channel = "can0"\nfoo_bar = 1', "can.can1.foo_bar = 1: unknown key of CAN interface"),
    ],
)
def test_a_bus_that_the_daemon_would_refuse_is_a_fault(keys: str, line: str) -> None:
    (found,) = complaints(in_bus(RIG, keys))
    assert found.startswith(line)


def test_the_check_prints_no_message_of_python_can(capfd: pytest.CaptureFixture[str]) -> None:
    complaints(in_bus(RIG, 'interface = "neovi"\nchannel = "0"'))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("line", ["", 'driver = "natnet"', 'driver = "other"', "driver = xbus"])
def test_a_wrong_driver_does_not_hide_the_faults_of_other_keys(tmp_path: Path, line: str) -> None:
    own = "reset_if_stuck = false"  # a key that no other driver has
    slow = RIG.replace('port = "/dev/ttyUSB0"', f'port = "/dev/ttyUSB0"\nbaud = 9600\n{own}')
    result = check(tmp_path, slow.replace('driver = "xbus"', line))
    assert "the line carries 9600" in result.stderr


def test_unknown_keys_of_a_driver_that_may_not_be_installed_are_no_faults() -> None:
    other = MOCAP.replace("natnet", "vendor").replace("server", "network")
    assert not any("network" in fault for fault in complaints(RIG + other))
