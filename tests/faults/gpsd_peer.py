"""gpsd as a peer of serial input: a simulated receiver on a pty, and a client that counts reports.

gpsd does not open a device again by itself. In Debian, udev starts ``gpsdctl add`` when a device
is plugged in; here, `GpsdPeer.plug` sends the same request to the control socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import functools
import json
import operator
import shutil
import time
from typing import TYPE_CHECKING

from jointfit_simulators.wires import PtyLine
from tests.broker_fixture import HOST, Broker, free_port

if TYPE_CHECKING:
    from collections.abc import AsyncIterator
    from pathlib import Path

PERIOD_S = 0.1
"""Time between two fixes of a receiver, s."""


def missing() -> str | None:
    """Return why gpsd cannot run here; None if it can."""
    if shutil.which("gpsd", path=Broker.PATH) is None:
        return "gpsd is not installed (Debian: apt install gpsd)"
    return None


def sentence(body: str) -> bytes:
    """Return an NMEA 0183 sentence with its checksum."""
    checksum = functools.reduce(operator.xor, body.encode())
    return f"${body}*{checksum:02X}\r\n".encode()


def fix(number: int, period_s: float = PERIOD_S) -> bytes:
    """Return the NMEA sentence RMC (recommended minimum data) of a fix."""
    at_s = number * period_s
    clock = f"{int(at_s // 3600):02d}{int(at_s % 3600 // 60):02d}{at_s % 60.0:06.3f}"
    return sentence(f"GPRMC,{clock},A,4807.038,N,01131.000,E,0.1,0.0,281126,,,A")


class GpsdPeer:
    """A running gpsd, its receiver and its client."""

    def __init__(self, line: PtyLine, control: Path) -> None:
        self.line, self._control = line, control
        self.sending = True
        """Whether the receiver sends a fix every `PERIOD_S`."""
        self.reports = 0
        """Positions (class TPV) that the client has received."""
        self._changed = asyncio.Event()

    async def send(self) -> None:
        """Send fixes until cancelled."""
        number = 0
        while True:
            if self.sending:
                self.line.write(fix(number))
                number += 1
            await asyncio.sleep(PERIOD_S)

    async def read(self, reader: asyncio.StreamReader) -> None:
        """Count reports until gpsd ends."""
        while line := await reader.readline():
            if json.loads(line)["class"] == "TPV":
                self.reports += 1
                self._changed.set()

    async def next_report(self) -> float:
        """Wait for a further report; return the elapsed time, s."""
        began_s = time.monotonic()
        self._changed.clear()
        await asyncio.wait_for(self._changed.wait(), 60.0)
        return time.monotonic() - began_s

    async def plug(self) -> None:
        """Plug the receiver in, and add it as udev does."""
        self.line.plug()
        self.line.link.resolve().chmod(0o666)  # as root, gpsd changes to a user of its own
        for sign in "-+":
            reader, writer = await asyncio.open_unix_connection(self._control)
            writer.write(f"{sign}{self.line.link}\r\n".encode())
            await reader.readline()
            writer.close()


@contextlib.asynccontextmanager
async def running_gpsd(folder: Path) -> AsyncIterator[GpsdPeer]:
    """Yield a gpsd that has reported a position; its user must be able to enter `folder`."""
    port, control = free_port(), folder / "gpsd.sock"
    peer = GpsdPeer(PtyLine(folder / "gps"), control)
    peer.line.link.resolve().chmod(0o666)
    program = shutil.which("gpsd", path=Broker.PATH)
    assert program is not None, missing()
    process = await asyncio.create_subprocess_exec(
        program, "-n", "-N", "-b", "-S", str(port), "-F", str(control), str(peer.line.link),
        stderr=asyncio.subprocess.DEVNULL,
    )  # fmt: skip
    tasks = [asyncio.create_task(peer.line.serve(lambda _: None))]
    tasks.append(asyncio.create_task(peer.send()))
    try:
        reader, writer = await _connected(port)
        writer.write(b'?WATCH={"enable":true,"json":true}\n')
        tasks.append(asyncio.create_task(peer.read(reader)))
        await peer.next_report()
        yield peer
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.wait(tasks)
        peer.line.unplug()
        process.kill()
        await process.wait()


async def _connected(port: int) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    async with asyncio.timeout(10.0):
        while True:
            with contextlib.suppress(OSError):
                return await asyncio.open_connection(HOST, port)
            await asyncio.sleep(0.05)
