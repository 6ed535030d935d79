"""`jointfit init` asks for required keys without default, for layouts, and for CAN identifiers."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.config import parse_rig
from jointfit_daemon.tools.discovery import DecodedDevice, SerialTraffic, _can_listening
from jointfit_daemon.tools.init import _search
from jointfit_daemon.tools.init._dialogue import Dialogue
from jointfit_daemon.tools.init._engine import complete, next_question
from jointfit_daemon.tools.init._found import FoundDevice, KeyChoice
from jointfit_daemon.tools.init._parsing import AnswerError
from jointfit_daemon.tools.init._rig_table import rig_table
from jointfit_daemon.tools.init._rig_text import rig_text
from jointfit_daemon.tools.init._search import DeviceSearch, drivers_found
from jointfit_simulators.devices import LpmsCanDevice, LpmsCanDeviceOptions, XcdiDevice

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from jointfit_protocols.can import CanFrame

LAYOUT = """
[frame]
sync = "AA 55"
length = 16
[fields]
quaternion = { offset = 7, type = "i16", divisor = 32767 }
"""
CAN_LAYOUT = "ids = { quaternion = 0x131 }\n[fields]\nquaternion = { offset = 0, type = 'i16' }\n"


def dialogue(*, devices: Iterable[str] = ()) -> Dialogue:
    """Return a dialogue about a rig with the sensors S1 and S2, up to their connections."""
    notes: list[str] = []
    search = DeviceSearch(notes.append, network=False)
    found = Dialogue(search, notes.append, lambda _: "", lambda _: None, drivers_found())
    answer(found, name="b", limb="knee", side="right", subject="p", output_rate_hz=100)
    answer(found, sensor_rate_hz=100, sensors="S1")
    answer(found, sensors="S2", can_adapters="")
    for device in devices:
        answer(found, device=device)
    return found


def answer(started: Dialogue, **answers: Any) -> None:
    for key, value in answers.items():
        asked = next_question(started.answers, started.found)
        assert asked is not None
        expected = key.rstrip("_")  # a caller appends "_" for a second answer to one question
        assert asked.question.key == expected, (asked.name, key)
        started.accept_answer(asked, value or asked.entered)


def finished(started: Dialogue) -> dict[str, Any]:
    """Return the table of the rig with defaults for the open questions, as read from its text."""
    while (asked := next_question(started.answers, started.found)) is not None:
        started.accept_answer(asked, asked.entered)
    table = tomllib.loads(rig_text(rig_table(started.answers, started.found)))
    parse_rig(table)
    return table


def question(started: Dialogue) -> Any:
    asked = next_question(started.answers, started.found)
    assert asked is not None
    return asked


def test_a_key_without_default_is_asked_for_with_the_meaning_of_its_values() -> None:
    started = dialogue(devices=["/dev/ttyUSB0"])
    answer(started, driver="lpms", baud=115200)
    asked = question(started)
    assert (asked.name, asked.text) == (
        "setting.S1.generation", "Setting generation of the sensor S1",
    )  # fmt: skip
    assert [(each.address, each.text) for each in asked.choices] == [
        ("1", "B2, CU2, URS2, CURS2, AL2, ME1"), ("3", "LPMS3, IG1, BE1, NAV3"),
    ]  # fmt: skip
    assert asked.default is None
    with pytest.raises(AnswerError, match="an answer is needed"):
        started.accept_answer(asked, None)
    answer(started, setting="3", device="/dev/ttyUSB1", driver="", baud="")
    assert question(started).default == "3"  # the next sensor gets the same proposal
    imus = finished(started)["imu"]
    assert [imu["generation"] for imu in imus] == [3, 3]


def test_the_meaning_of_a_value_ends_before_that_of_the_next() -> None:
    choice = KeyChoice("mode", ("a", "b", "c"), "`a`: one, two; `b`: three. Four")
    assert [choice.meaning(value) for value in choice.values] == ["one, two", "three", ""]


def test_a_layout_in_a_file_becomes_part_of_the_table(tmp_path: Path) -> None:
    file = tmp_path / "board.toml"
    file.write_text(LAYOUT)
    started = dialogue(devices=["/dev/ttyUSB0"])
    answer(started, driver="serial-table", baud=115200, device="/dev/ttyUSB1", driver_="", baud_="")
    answer(started, layout=str(file))
    assert question(started).default == str(file)  # the next sensor gets the same proposal
    for imu in finished(started)["imu"]:
        assert imu["frame"] == {"sync": "AA 55", "length": 16}
        assert imu["fields"]["quaternion"]["divisor"] == 32767


def test_a_can_layout_names_its_identifiers_and_a_rig_is_read_as_well(tmp_path: Path) -> None:
    files = []
    for number in (0x131, 0x141):
        text = CAN_LAYOUT.replace("0x131", hex(number))
        rig = f"[[imu]]\ndriver = 'can-table'\n{text}".replace("[fields]", "[imu.fields]")
        files.append(tmp_path / f"{number}.toml")
        files[-1].write_text(rig)
    started = dialogue(devices=["can0"])
    answer(started, driver="can-table", device="can0", driver_="")
    answer(started, layout=str(files[0]), layout_=str(files[1]))
    ids = [imu["ids"] for imu in finished(started)["imu"]]
    assert ids == [{"quaternion": 0x131}, {"quaternion": 0x141}]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "No such file"),
        ("a =", "expected TOML"),
        ("[rig]\nname = 'b'\n", "found rig, expected `fields`"),
        (LAYOUT.replace("length = 16", "length = 8"), "frame"),
    ],
)
def test_an_unusable_layout_is_refused_with_the_expected_one(
    tmp_path: Path, text: str | None, message: str
) -> None:
    file = tmp_path / "board.toml"
    if text is not None:
        file.write_text(text)
    started = dialogue(devices=["/dev/ttyUSB0"])
    answer(started, driver="serial-table", baud=115200, device="/dev/ttyUSB1", driver_="", baud_="")
    with pytest.raises(AnswerError, match=message):
        answer(started, layout=str(file))


def test_the_driver_that_decodes_the_data_of_a_port_is_proposed_with_its_speed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    port = "/dev/ttyUSB0"
    device = DecodedDevice("mip", {}, 10, 10, 100.0, 0)
    heard = SerialTraffic(port, None, {921_600: 900}, 921_600, (device,))
    monkeypatch.setattr(_search, "listen_serial", lambda *_, **__: heard)
    started = dialogue(devices=[port])
    started.find(question(started))
    assert question(started).default == "mip"
    answer(started, driver="")
    assert question(started).default == 921_600

    silent = SerialTraffic(port, None, {115_200: 0})
    monkeypatch.setattr(_search, "listen_serial", lambda *_, **__: silent)
    with pytest.raises(AnswerError, match="silent"):
        started.search.recognized_driver(started.found, port)


def test_the_cameras_are_those_of_the_server_that_was_found_with_its_port(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    started = dialogue(devices=["later", "later"])
    address = FoundDevice("10.0.0.7:4000", "VRPN")
    monkeypatch.setattr(DeviceSearch, "start", lambda *_: started.found)
    started.found = _with_server(started.found, address, "vrpn")
    answer(started, cameras="yes")
    assert question(started).default == "vrpn"
    answer(started, mocap_driver="", server="")
    mocap = rig_table_of(started)["mocap"]
    assert (mocap["driver"], mocap["server"], mocap["port"]) == ("vrpn", "10.0.0.7", 4000)


def _with_server(found: Any, server: FoundDevice, driver: str) -> Any:
    return replace(found, servers=(server,), server_drivers={server.address: driver})


def rig_table_of(started: Dialogue) -> dict[str, Any]:
    return rig_table(complete(started.answers, started.found), started.found)


# --- identifiers without default ------------------------------------------------------------------


class _Bus:
    """CAN bus that collects the frames of simulated sensors."""

    bitrate = None
    is_open = True

    def __init__(self) -> None:
        self.frames: list[CanFrame] = []

    def send(self, frames: list[CanFrame]) -> bool:
        self.frames += frames
        return True


@pytest.fixture
def can0(monkeypatch: pytest.MonkeyPatch) -> None:
    """Provide a bus with an XCDI sensor and two LPMS sensors.

    One LPMS sensor has the mode ``canopen``, the other the mode ``sequential`` with floats.
    """
    bus: Any = _Bus()
    sequential = LpmsCanDeviceOptions(
        mode="sequential", ids=(0x514, 0x515, 0x516, 0x517), precision="float32"
    )
    sensors: list[Any] = [LpmsCanDevice(bus), LpmsCanDevice(bus, sequential), XcdiDevice(bus)]
    received: list[tuple[int, int, bytes]] = []
    for number in range(40):
        for sensor in sensors:
            sensor.push(number * 10_000_000, (0.5, -0.5, 0.1, 0.7))
        for frame in bus.frames:
            t_ns = number * 10_000_000 + 100_000 * len(received) % 10_000_000
            received.append((t_ns, frame.can_id, frame.data))
        bus.frames.clear()
    monkeypatch.setattr(_can_listening, "_receive", lambda *_: received)
    found = (FoundDevice("can0", "CAN interface, up"),)
    monkeypatch.setattr(DeviceSearch, "refresh", lambda _, old: replace(old, interfaces=found))


@pytest.mark.usefixtures("can0")
def test_sensors_on_can_are_found_with_the_settings_that_their_frames_show() -> None:
    started = dialogue(devices=["can0"])
    started.next()  # finds the interface
    asked = question(started)
    assert {"xcdi", "lpms-can", "can-table"} == {each.address for each in asked.choices}
    started.find(asked)
    answer(started, driver="lpms-can")
    mode, ids = question(started), (0x181, 0x281, 0x381, 0x481)
    assert (mode.name, mode.default) == ("setting.S1.mode", "canopen")
    answer(started, setting="", setting_="")
    assert question(started).default == ids
    answer(started, ids="", device="can0", driver="lpms-can", setting="", setting_="")
    assert question(started).default == (0x514, 0x515, 0x516, 0x517)
    first, second = finished(started)["imu"]
    assert (first["mode"], first["precision"]) == ("canopen", "int16")
    assert tuple(first["ids"].values()) == ids
    assert (second["mode"], second["precision"]) == ("sequential", "float32")
    assert list(second["ids"]) == ["frame1", "frame2", "frame3", "frame4"]


@pytest.mark.usefixtures("can0")
def test_a_received_sensor_with_other_settings_is_named() -> None:
    started = dialogue(devices=["can0"])
    answer(started, driver="lpms-can", setting="canopen", setting_="float32")
    with pytest.raises(AnswerError, match=r"lpms-can 0x181 0x281 .*, mode canopen, precision int1"):
        started.find(question(started))


def test_typed_identifiers_are_those_of_their_mode() -> None:
    started = dialogue(devices=["can0"])
    answer(started, driver="lpms-can", setting="sequential", setting_="int16")
    asked = question(started)
    assert asked.help.startswith(
        "frame1, frame2, frame3, frame4, such as 0x000 0x001 0x002 0x003. "
    )
    with pytest.raises(AnswerError, match=r"sequential identifiers follow each other"):
        answer(started, ids="0x181 0x281 0x381 0x481")
    with pytest.raises(AnswerError, match="expected 4 identifiers"):
        answer(started, ids="0x181")
    answer(started, ids="0x101 0x102 0x103 0x104", device="/dev/ttyUSB0")
    assert finished(started)["imu"][0]["ids"]["frame4"] == 0x104
