"""A simulated device detects that a host has opened its serial port for the first time."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_simulators.scene._opened_port import OpenedPort
from jointfit_simulators.wires import PtyLine

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture
def line(tmp_path: Path) -> Iterator[PtyLine]:
    found = PtyLine(tmp_path / "tty")
    yield found
    found.unplug()


async def test_a_port_is_read_a_while_after_its_opening(line: PtyLine) -> None:
    """A host counts as a reader `RESTART_S` after it has opened the port for the first time."""
    port = OpenedPort(line.link)
    read = [port.is_read]
    with SerialPort(str(line.link), 115_200):
        read.append(port.is_read)
        await asyncio.sleep(0.25)
        read.append(port.is_read)
    read.append(port.is_read)  # unchanged after the host has closed the port
    assert read == [False, False, True, True]


def test_a_port_is_not_read_without_host_or_without_wire(line: PtyLine) -> None:
    port = OpenedPort(line.link)
    read = [port.is_read]
    line.unplug()
    read.append(port.is_read)
    assert read == [False, False]
