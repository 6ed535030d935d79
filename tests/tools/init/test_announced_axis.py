"""`jointfit init` writes no vertical axis for a driver whose server announces the axis."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import pytest

from jointfit_daemon.tools.init._found import MocapDriver
from jointfit_daemon.tools.init._rig_table import rig_table
from jointfit_daemon.tools.init._search import drivers_found
from tests.tools.init.dialogues import NOTHING, completed

if TYPE_CHECKING:
    from jointfit_daemon.tools.init._engine import Asked


def mocap_of(driver: MocapDriver) -> dict[str, Any]:
    """Return the ``[mocap]`` table of a dialogue in which every proposal is accepted."""
    found = replace(NOTHING, mocap_drivers=(driver,))

    def choose(asked: Asked) -> Any:
        own = {"cameras": "yes", "server": "10.0.0.5"}
        return own.get(asked.question.key, asked.default)

    table: dict[str, Any] = rig_table(completed(found, choose), found)["mocap"]
    return table


def test_an_announced_axis_is_neither_asked_for_nor_overridden() -> None:
    table = mocap_of(MocapDriver("qtm", 22223, "auto"))
    assert (table["driver"], table["server"]) == ("qtm", "10.0.0.5")
    assert "up_axis" not in table


def test_the_default_axis_of_another_driver_is_written() -> None:
    assert mocap_of(MocapDriver("natnet", 1510, "y"))["up_axis"] == "y"
    assert mocap_of(MocapDriver("natnet", 1510, "z"))["up_axis"] == "z"


@pytest.mark.parametrize(("name", "axis"), [("natnet", "y"), ("qtm", "auto"), ("vicon", "auto")])
def test_the_dialogue_knows_which_servers_announce_their_axis(name: str, axis: str) -> None:
    (driver,) = (driver for driver in drivers_found().mocap_drivers if driver.name == name)
    assert driver.up_axis == axis
