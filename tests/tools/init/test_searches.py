"""`jointfit init` finds a moved sensor, the identifiers on a CAN bus, and the installed drivers."""

from __future__ import annotations

import asyncio
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, ClassVar

import pytest

from jointfit_daemon.driver import DeviceLostError, ImuSettings
from jointfit_daemon.model import Chunk, ImuSample
from jointfit_daemon.tools import discovery
from jointfit_daemon.tools.discovery import CanTraffic, DecodedDevice
from jointfit_daemon.tools.init import _movement, _search
from jointfit_daemon.tools.init._found import CanSensor, FoundDevice, ImuDriver
from jointfit_daemon.tools.init._movement import find_moved
from jointfit_daemon.tools.init._parsing import AnswerError
from jointfit_daemon.tools.init._search import DeviceSearch, drivers_found
from tests.tools.init.dialogues import DEVICES, completed

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.driver import Emit
    from jointfit_daemon.tools.init._engine import Asked

pytestmark = pytest.mark.usefixtures("one_driver_of_each_kind")

TURNS: dict[str, float] = {}
"""Rotation of each simulated device at its last sample, rad."""


ASKED = asyncio.Event()
"""Event that is set when the dialogue asks the user to turn a sensor."""


def ask(line: str) -> None:
    if "Turn the sensor S1" in line:
        ASKED.set()


class TurningSettings(ImuSettings):
    port: str
    baud: int = 9600


class TurningImu:
    """A device whose orientation turns about z up to an angle; it answers at one speed only."""

    Settings: ClassVar[type[TurningSettings]] = TurningSettings
    usual_bauds: ClassVar[tuple[int, ...]] = (9600, 460_800)

    def __init__(self, settings: TurningSettings) -> None:
        self._settings = settings

    def decoder(self) -> TurningImu:
        return self

    def feed(self, chunk: Chunk) -> list[ImuSample]:
        half = float(chunk.data) / 2
        q = (math.cos(half), 0.0, 0.0, math.sin(half))
        return [ImuSample(0, q, q, None, None)]

    async def run(self, emit: Emit) -> None:
        if self._settings.baud != 460_800:
            raise DeviceLostError("no answer at this speed")
        angle = 0.0
        while True:
            emit(Chunk(0, str(angle).encode()))
            if ASKED.is_set():
                angle = min(angle + 0.05, TURNS[self._settings.port])
            await asyncio.sleep(0.002)


@pytest.fixture
def imus(monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, dict[str, Any]]]:
    monkeypatch.setattr(_movement, "find_driver", lambda _name: TurningImu)
    monkeypatch.setattr(_movement, "TURN_S", 1.0)
    monkeypatch.setattr(_movement, "_RETRY_S", 0.01)

    def connect(**turns_deg: float) -> dict[str, dict[str, Any]]:
        TURNS.clear()
        ASKED.clear()
        TURNS.update({f"/dev/{name}": math.radians(turn) for name, turn in turns_deg.items()})
        return {port: {"driver": "turning", "port": port} for port in TURNS}

    return connect


async def test_the_turned_sensor_is_found_with_its_speed(
    imus: Callable[..., dict[str, dict[str, Any]]],
) -> None:
    address, table = await find_moved("S1", imus(a=3, b=85, c=10), 100, ask)
    assert (address, table["baud"]) == ("/dev/b", 460_800)


@pytest.mark.parametrize("turns", [{"a": 3.4, "b": 2.4}, {"a": 80, "b": 85}])
async def test_no_sensor_or_two_that_turn_are_refused_with_their_angles(
    imus: Callable[..., dict[str, dict[str, Any]]], turns: dict[str, float]
) -> None:
    with pytest.raises(AnswerError, match=r"turned alone \(/dev/a [38]\d?°, /dev/b [28]\d?°"):
        await find_moved("S1", imus(**turns), 100, ask)


def test_identifiers_on_a_bus_become_proposals(monkeypatch: pytest.MonkeyPatch) -> None:
    ids = {"sample_time": 0x105, "group_counter": 0x106, "quaternion": 0x121}
    device = DecodedDevice("xcdi", {"ids": ids}, 30, 10, 100.0, 0)
    monkeypatch.setattr(_search, "listen_can", lambda bus: CanTraffic(bus, None, (), (device,)))
    found = DeviceSearch(print).identifiers(DEVICES, "can0")
    assert found.can_sensors == {"can0": (CanSensor("xcdi", (0x105, 0x106, 0x121)),)}


@pytest.mark.parametrize(
    ("bus", "fault", "words"),
    [
        ("/dev/ttyACM0", None, "serial adapter"),
        ("can0", "can0: the interface is down", "the interface is down"),
        ("can0", None, "no data of a sensor were received"),
    ],
)
def test_a_bus_without_sensors_is_explained(
    monkeypatch: pytest.MonkeyPatch, bus: str, fault: str | None, words: str
) -> None:
    monkeypatch.setattr(_search, "listen_can", lambda name: CanTraffic(name, fault))
    with pytest.raises(AnswerError, match=words):
        DeviceSearch(print).identifiers(DEVICES, bus)


def test_a_sensor_that_moves_on_a_bus_is_found_by_its_identifiers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    devices = tuple(
        DecodedDevice(
            "xcdi",
            {"ids": {"sample_time": k + 5, "group_counter": k + 6, "quaternion": k + 0x21}},
            30, 10, 100.0, 0,
        )
        for k in (0x100, 0x200, 0x300)
    )  # fmt: skip
    monkeypatch.setattr(_search, "listen_can", lambda bus: CanTraffic(bus, None, (), devices))
    offered: list[str] = []

    async def last(_sensor: str, tables: dict[str, Any], *_: object) -> tuple[str, dict[str, Any]]:
        offered.extend(tables)
        return list(tables.items())[-1]

    monkeypatch.setattr(_search, "find_moved", last)
    answers = {
        ("can_adapters", ""): (), ("sensor_rate_hz", ""): 100, ("ids", "S1"): (0x105, 0x106, 0x121)
    }  # fmt: skip
    found, address = DeviceSearch(print).moved_device(
        DEVICES, answers, "S2", (FoundDevice("can0"),)
    )
    assert offered == ["can0 0x205 0x206 0x221", "can0 0x305 0x306 0x321"]
    assert address == "can0"
    assert found.can_sensors["can0"][0].ids == (0x305, 0x306, 0x321)


def test_installed_drivers_are_described_by_the_keys_the_dialogue_asks_for() -> None:
    found = drivers_found()
    drivers = {driver.name: driver for driver in found.imu_drivers}
    assert (drivers["xbus"].wiring, drivers["xbus"].baud) == ("serial", 115_200)
    assert drivers["xcdi"].wiring == "can"
    assert list(drivers["xcdi"].ids) == ["sample_time", "group_counter", "quaternion"]
    assert [(driver.name, driver.port) for driver in found.mocap_drivers] == [("natnet", 1510)]


def test_the_usual_drivers_lead_the_installed_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_search, "installed_drivers", discovery.installed_drivers)
    found = drivers_found()
    names = [driver.name for driver in found.imu_drivers]
    assert names[:2] == ["xbus", "xcdi"]
    assert names[2:] == sorted(names[2:])
    assert {"mip", "witmotion"} <= set(names[2:])
    assert found.mocap_drivers[0].name == "natnet"


def test_the_driver_of_a_sensor_is_proposed_for_the_next_one() -> None:
    other = ImuDriver("mip", "serial", 115_200)
    found = replace(DEVICES, imu_drivers=(*DEVICES.imu_drivers, other))
    proposed: dict[str, str] = {}

    def choose(asked: Asked) -> object:
        if asked.question.key == "device":
            return f"/dev/tty{asked.subject}"
        if asked.question.key == "driver":
            proposed[asked.subject] = asked.default
            return "mip" if len(proposed) == 1 else asked.default
        return asked.default

    answers = completed(found, choose)
    sensors = [name for key, name in answers if key == "driver"]
    assert len(sensors) > 2
    assert list(proposed.values()) == ["xbus", *["mip"] * (len(sensors) - 1)]
