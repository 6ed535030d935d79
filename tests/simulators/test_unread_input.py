"""The simulator closes a serial port only when its host has read all bytes."""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING

import pytest

from jointfit_drivers.ports.serial_port import SerialPort
from jointfit_simulators.wires import PtyLine, wait_until_read

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

SENT = bytes(range(256)) * 64
"""Bytes that the device sends: more than the 4 KB that the kernel passes to a reader at once."""


@pytest.fixture
def line(tmp_path: Path) -> Iterator[PtyLine]:
    found = PtyLine(tmp_path / "tty")
    yield found
    found.unplug()


async def test_a_host_that_is_behind_receives_every_byte_before_the_port_closes(
    line: PtyLine,
) -> None:
    received = bytearray()
    with SerialPort(str(line.link), 115_200) as port:
        serving = asyncio.create_task(line.serve(lambda _: None))
        await asyncio.sleep(0)
        assert line.write(SENT)
        waiting = asyncio.create_task(wait_until_read([line.link]))
        await asyncio.sleep(0.8)  # the host is busy
        assert not waiting.done()

        while not waiting.done():
            if (chunk := await port.receive(0.1)) is not None:
                received += chunk.data
        serving.cancel()
    assert bytes(received) == SENT


async def test_a_host_that_reads_nothing_is_not_waited_for_without_end(line: PtyLine) -> None:
    with SerialPort(str(line.link), 115_200):
        assert line.write(SENT)
        async with asyncio.timeout(4.0):
            await wait_until_read([line.link])


async def test_an_absent_port_is_not_waited_for(tmp_path: Path) -> None:
    async with asyncio.timeout(1.0):
        await wait_until_read([tmp_path / "absent"])
