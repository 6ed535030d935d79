"""`jointfit init` writes a valid rig.toml from the input of a terminal, a script or a file."""

from __future__ import annotations

import json
import os
import stat
import tomllib
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import pytest
from typer.testing import CliRunner

from jointfit_daemon.config import LATER, load_rig
from jointfit_daemon.device_search import FoundServer
from jointfit_daemon.tools.__main__ import app
from jointfit_daemon.tools.discovery import SerialPortInfo
from jointfit_daemon.tools.init import _command, _search

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

pytestmark = pytest.mark.usefixtures("one_driver_of_each_kind")

LEG = FoundServer(
    "natnet", "192.168.1.10", 1510, "192.168.1.2", "Motive", "3.1", "NatNet 4.1", "unicast",
    bodies=("Plate",), markers=tuple(f"{stem}{k}" for stem in "TSF" for k in range(1, 5)),
)  # fmt: skip


@dataclass
class Machine:
    """The devices of a machine, which a test can change."""

    ports: list[str] = field(default_factory=list)
    servers: list[FoundServer] = field(default_factory=list)
    asked: list[Sequence[str]] = field(default_factory=list)


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    simulated = Machine()

    async def servers(hosts: Sequence[str] = (), **_options: Any) -> list[FoundServer]:
        simulated.asked.append(tuple(hosts))
        return simulated.servers

    monkeypatch.setattr(
        _search, "find_serial_ports", lambda: [SerialPortInfo(port) for port in simulated.ports]
    )
    monkeypatch.setattr(_search, "find_can_interfaces", list)
    monkeypatch.setattr(_search, "find_mocap_servers", servers)
    return simulated


def init(*arguments: object, lines: Sequence[str] = ()) -> Any:
    text = "".join(f"{line}\n" for line in lines)
    return CliRunner().invoke(app, ["init", *map(str, arguments)], input=text)


def answer_file(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


PORTS = """
[device]
thigh-front = "/dev/ttyUSB0"
thigh-side = "/dev/ttyUSB1"
shank-front = "/dev/ttyUSB2"
shank-side = "/dev/ttyUSB3"
"""
TYPED = ["膝-1", "", "left", "", "", "", "a", "b", "", "1", "", "1", "", "", "", "", "", ""]
"""Lines of a whole dialogue with two sensors and without cameras; an empty line accepts the
proposal."""


def test_a_typed_dialogue_writes_a_rig_that_check_accepts(tmp_path: Path, machine: Machine) -> None:
    machine.ports = ["/dev/ttyUSB0", "/dev/ttyUSB1"]
    done = init(tmp_path / "lab", lines=TYPED)
    assert done.exit_code == 0, done.output
    rig = load_rig(tmp_path / "lab/rig.toml")
    assert rig.name == "膝-1"
    assert rig.chain.left_side
    assert [(s.id, s.settings.port) for s in rig.sources] == [
        ("a", "/dev/ttyUSB0"),
        ("b", "/dev/ttyUSB1"),
    ]
    assert f"jointfitd --config {tmp_path / 'lab/rig.toml'}" in done.output
    assert "jointfit dashboard  " in done.output  # the usual broker needs no option
    assert [path.name for path in (tmp_path / "lab").iterdir()] == ["rig.toml"]
    checked = CliRunner().invoke(app, ["check", str(tmp_path / "lab/rig.toml")])
    assert checked.exit_code == 0


def test_enter_at_every_question_leaves_open_places_that_check_explains_and_init_fills(
    tmp_path: Path, machine: Machine
) -> None:
    rig, state = tmp_path / "rig.toml", tmp_path / "rig.answers.toml"
    assert machine.ports == []
    done = init(tmp_path, lines=[""] * 18)
    assert done.exit_code == 0, done.output
    assert "imu[thigh-front].port" in done.output
    assert f"jointfit init {tmp_path} --force" in done.output

    checked = CliRunner().invoke(app, ["check", str(rig)])
    assert checked.exit_code == 2
    assert checked.output.count("not filled in yet: connect the sensor") == 4
    assert "4 faults" in checked.output

    # The next run asks for the postponed answers only. Two of them are answered, and the others
    # remain.
    machine.ports = [f"/dev/ttyUSB{k}" for k in range(4)]
    done = init(tmp_path, "--force", lines=["1", "", "later", "1", "", ""])
    assert done.exit_code == 0, done.output
    ports = [imu["port"] for imu in tomllib.loads(rig.read_text())["imu"]]
    assert ports == ["/dev/ttyUSB0", "later", "/dev/ttyUSB1", "later"]
    done = init(tmp_path, "--force", lines=["1", "", "/dev/ttyUSB3", ""])
    assert done.exit_code == 0, done.output
    assert [s.settings.port for s in load_rig(rig).sources] == [
        "/dev/ttyUSB0", "/dev/ttyUSB2", "/dev/ttyUSB1", "/dev/ttyUSB3",
    ]  # fmt: skip
    assert not state.exists()


def test_an_interruption_while_open_places_are_filled_loses_no_answer(
    tmp_path: Path, machine: Machine
) -> None:
    assert init(tmp_path, lines=["rig-7", *[""] * 17]).exit_code == 0
    machine.ports = ["/dev/ttyUSB0", "/dev/ttyUSB1"]
    assert init(tmp_path, "--force", lines=["1"]).exit_code == 2  # the input ends
    done = init(tmp_path, "--force", lines=[""] * 4)
    assert done.exit_code == 0, done.output
    table = tomllib.loads((tmp_path / "rig.toml").read_text())
    assert table["rig"]["name"] == "rig-7"
    assert [imu["port"] for imu in table["imu"]] == ["/dev/ttyUSB0", *["later"] * 3]


def test_a_script_is_asked_for_a_connection_unless_it_postpones_it(
    tmp_path: Path, machine: Machine
) -> None:
    assert machine.ports == []
    file = answer_file(tmp_path / "a.toml", PORTS.replace('"/dev/ttyUSB3"', '"later"'))
    done = init(tmp_path / "lab", "--answers", file, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["open"] == ["imu[shank-side].port"]


def test_the_computer_of_the_cameras_can_be_postponed(tmp_path: Path, machine: Machine) -> None:
    assert machine.ports == []
    lines = ["", "planar", *[""] * 12]
    assert init(tmp_path, lines=lines).exit_code == 0
    checked = CliRunner().invoke(app, ["check", str(tmp_path / "rig.toml")])
    assert "mocap.server = 'later': not filled in yet" in checked.output
    assert "1 fault" in checked.output


UNKNOWN = """
cameras = true
server = "192.168.1.10"
plate = "later"
[sensors]
thigh = ["a"]
shank = ["b"]
[device]
a = "can0"
b = "can0"
[ids]
a = "later"
b = "later"
[markers]
thigh = "later"
shank = "later"
"""
OPEN = ["imu[a].ids", "imu[b].ids", "mocap.plate", "mocap.markers.thigh", "mocap.markers.shank"]


@pytest.mark.usefixtures("machine")
def test_identifiers_and_names_that_are_unknown_are_filled_in_later(tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    file = answer_file(tmp_path / "a.toml", UNKNOWN)
    done = init(tmp_path, "--answers", file, "--json")
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["open"] == OPEN
    assert f'ids = "{LATER}"' in rig.read_text()

    # Every postponed answer is one fault with its remedy, and there are no other faults.
    for command in (["check"], ["doctor", "--config"]):
        checked = CliRunner().invoke(app, [*command, str(rig)])
        assert checked.exit_code == 2
        assert checked.output.count("not filled in yet: enter the") == len(OPEN)
        assert "5 faults" in checked.output

    # The dialogue asks for the postponed answers only, some of them a second time.
    identifiers = ["0x105 0x106 0x121", "later"]
    markers = ["T1, T2, T3", "S1, S2, S3"]
    assert init(tmp_path, "--force", lines=[*identifiers, *markers, "Plate"]).exit_code == 0
    assert tomllib.loads(rig.read_text())["imu"][1]["ids"] == LATER
    assert init(tmp_path, "--force", lines=["0x205 0x206 0x221"]).exit_code == 0
    cameras = load_rig(rig).sources[-1].settings
    assert cameras.plate == "Plate"
    assert cameras.markers["shank"] == ("S1", "S2", "S3")
    assert not (tmp_path / "rig.answers.toml").exists()


def test_help_names_the_enter_key_only_where_there_is_a_proposal(
    tmp_path: Path, machine: Machine
) -> None:
    machine.ports = ["/dev/ttyUSB0"]
    done = init(tmp_path, lines=[*[""] * 8, "?", "", "can0", "?", ""])
    before, _, ids = done.output.partition("CAN identifiers of")
    assert "Enter takes the proposal" not in before.partition("Serial ports that are")[2]
    assert "Enter takes the proposal in brackets, '<' goes back one question." in ids
    assert "[later] ('find' searches)" in ids


@pytest.mark.parametrize("kept", range(0, len(TYPED), 3))
def test_an_interrupted_dialogue_continues_with_its_answers(
    tmp_path: Path, machine: Machine, monkeypatch: pytest.MonkeyPatch, kept: int
) -> None:
    machine.ports = ["/dev/ttyUSB0", "/dev/ttyUSB1"]
    assert init(tmp_path / "whole", lines=TYPED).exit_code == 0

    lines = iter(TYPED[:kept])

    def interrupted_reader(_show: object) -> Callable[[str], str]:
        def read_line(_prompt: str) -> str:
            for line in lines:
                return line
            raise KeyboardInterrupt

        return read_line

    with monkeypatch.context() as patch:
        patch.setattr(_command, "_reader", interrupted_reader)
        stopped = init(tmp_path / "lab")
    assert stopped.exit_code == 130
    assert f"{kept} answers are in {tmp_path / 'lab/rig.answers.toml'}" in stopped.output
    assert not (tmp_path / "lab/rig.toml").exists()

    assert init(tmp_path / "lab", lines=TYPED[kept:]).exit_code == 0
    written = [(tmp_path / name / "rig.toml").read_text() for name in ("whole", "lab")]
    assert written[0] == written[1]


def test_the_end_of_the_input_names_the_file_that_continues(
    tmp_path: Path, machine: Machine
) -> None:
    assert machine.ports == []
    done = init(tmp_path, lines=["rig-1"])
    assert done.exit_code == 2
    assert "1 answers are in" in done.output
    assert init(tmp_path, "--restart", lines=["rig-2", *TYPED[1:9], *["/dev/a", "", "/dev/b"],
                *[""] * 6]).exit_code == 0  # fmt: skip
    assert load_rig(tmp_path / "rig.toml").name == "rig-2"


def test_help_and_return_are_words_of_every_question(tmp_path: Path, machine: Machine) -> None:
    machine.ports = ["/dev/ttyUSB0", "/dev/ttyUSB1"]
    done = init(tmp_path, lines=["?", "wrong", "<", *TYPED])
    assert done.exit_code == 0, done.output
    assert "Letters of any script" in done.output
    assert load_rig(tmp_path / "rig.toml").name == "膝-1"


def test_an_answer_file_suffices_and_the_result_is_one_json_object(
    tmp_path: Path, machine: Machine
) -> None:
    machine.servers = [LEG]
    file = answer_file(tmp_path / "a.toml", f'name = "s-1"\n{PORTS}')
    done = init(tmp_path, "--answers", file, "--json")
    assert done.exit_code == 0, done.output
    result = json.loads(done.stdout)
    assert result["rig"] == str(tmp_path / "rig.toml")
    assert result["table"]["mocap"]["markers"] == {
        part: [f"{stem}{k}" for k in range(1, 5)]
        for part, stem in (("thigh", "T"), ("shank", "S"), ("foot", "F"))
    }
    assert machine.asked == [(), ("192.168.1.10",)]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "device.thigh-front is missing, and there is no proposal"),
        (f"nmae = 'x'{PORTS}", "did you mean 'name'"),
        (f"limb = 'leg'{PORTS}", "expected one of knee, legs, arm, trunk, planar"),
        ("limb = [", "expected TOML"),
        (f"cameras = true{PORTS}", "server is missing"),
        (f"{PORTS}\n[sensors]\nfoot = ['x']", "sensors.foot: there is no such question"),
    ],
)
def test_a_faulty_answer_file_is_refused_by_the_name_of_the_question(
    tmp_path: Path, machine: Machine, text: str, words: str
) -> None:
    assert machine.servers == []
    done = init(tmp_path, "--answers", answer_file(tmp_path / "a.toml", text))
    assert done.exit_code == 2
    assert words in done.output
    assert not (tmp_path / "rig.toml").exists()


def test_a_device_that_vanishes_between_questions_leaves_the_list(
    tmp_path: Path, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine.ports = ["/dev/ttyUSB0", "/dev/ttyUSB1"]
    reader = _command._reader

    def vanishing(show: Callable[[str], None]) -> Callable[[str], str]:
        read = reader(show)

        def read_line(prompt: str) -> str:
            line = read(prompt)
            if line == "gone\n":  # between two questions
                machine.ports.remove("/dev/ttyUSB1")
                line = "115200\n"
            return line

        return read_line

    monkeypatch.setattr(_command, "_reader", vanishing)
    lines = [*TYPED[:9], "1", "gone", "1", "/dev/ttyUSB1", *[""] * 6]
    done = init(tmp_path, lines=lines)
    assert "found the number 1, the list has 0 entries" in done.output
    assert "/dev/ttyUSB1 is absent now; connect it before the daemon starts" in done.output
    assert done.exit_code == 0, done.output


def test_a_password_is_in_a_file_for_its_owner_and_never_in_the_rig(
    tmp_path: Path, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert machine.ports == []
    monkeypatch.setenv("JOINTFIT_MQTT_PASSWORD", "Zx9-geheim")
    file = answer_file(tmp_path / "a.toml", f'username = "gateway"\n{PORTS}')
    done = init(tmp_path, "--answers", file)
    assert done.exit_code == 0, done.output
    password = tmp_path / "mqtt-password"
    assert password.read_text() == "Zx9-geheim\n"
    assert stat.S_IMODE(password.stat().st_mode) == 0o600
    assert "Zx9" not in (tmp_path / "rig.toml").read_text() + done.output
    assert load_rig(tmp_path / "rig.toml").mqtt.password_file == str(password)


def test_the_next_commands_quote_a_path_with_spaces(tmp_path: Path, machine: Machine) -> None:
    assert machine.ports == []
    done = init(tmp_path / "my lab", "--answers", answer_file(tmp_path / "a.toml", PORTS))
    assert f"jointfit check '{tmp_path / 'my lab' / 'rig.toml'}'" in done.output


def test_an_existing_rig_is_replaced_only_with_force(tmp_path: Path, machine: Machine) -> None:
    assert machine.ports == []
    rig = answer_file(tmp_path / "rig.toml", "mine")
    file = answer_file(tmp_path / "a.toml", PORTS)
    done = init(tmp_path, "--answers", file)
    assert (done.exit_code, rig.read_text()) == (2, "mine")
    assert "replace it with --force" in done.output
    assert init(tmp_path, "--answers", file, "--force").exit_code == 0
    assert tomllib.loads(rig.read_text())["rig"]["name"] == "bench-1"


def test_a_folder_that_cannot_be_written_is_reported_before_the_first_question(
    tmp_path: Path, machine: Machine, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    done = init(tmp_path / "file")
    assert (done.exit_code, "file" in done.output) == (2, True)

    monkeypatch.setattr(os, "access", lambda _path, mode: mode != os.W_OK)
    done = init(tmp_path)
    assert (done.exit_code, machine.asked) == (2, [])
    assert "no write permission" in done.output
