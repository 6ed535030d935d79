"""Child processes of the demo and of system tests: the simulator and the daemon."""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import orjson

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Sequence
    from pathlib import Path

READY_S = 30.0
"""Time limit for the start of a process, s. A Raspberry Pi needs 10 s to import SciPy."""
STOP_S = 10.0
"""Time limit for the end of a process after SIGTERM, s. At this limit, the process is killed."""


class ProcessExitedError(Exception):
    """A child process exited unexpectedly; the message contains the end of its log."""


class DemoTimeoutError(Exception):
    """A step of the demo exceeded its time limit; the message names the step."""


@contextlib.asynccontextmanager
async def time_limit(seconds: float, step: str) -> AsyncIterator[None]:
    """Raise `DemoTimeoutError` if a step of the demo exceeds its time limit.

    Raises
    ------
    DemoTimeoutError
        The ``with`` block took longer than `seconds`.
    """
    try:
        async with asyncio.timeout(seconds):
            yield
    except TimeoutError as late:
        raise DemoTimeoutError(
            f"{step} took longer than {seconds:g} s: check the load of this machine, or"
            " keep the logs with --keep FOLDER"
        ) from late


@dataclass(slots=True)
class ChildProcess:
    """Child process whose output is written to a log file in `folder`."""

    name: str
    arguments: Sequence[str]
    folder: Path
    environment: dict[str, str]
    process: asyncio.subprocess.Process | None = None

    async def __aenter__(self) -> Self:
        """Start the process."""
        with (self.folder / f"{self.name}.log").open("wb") as log:
            self.process = await asyncio.create_subprocess_exec(
                *self.arguments,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE if self.name == "simulator" else log,
                stderr=log,
                env=os.environ | self.environment,
                limit=1 << 20,
            )

        return self

    async def __aexit__(self, *ended: object) -> None:
        """Terminate the process; kill it after `STOP_S`."""
        process = self.process
        if process is None:
            return

        with contextlib.suppress(ProcessLookupError):
            process.terminate()

        try:
            async with asyncio.timeout(STOP_S):
                await process.wait()
        except TimeoutError:
            process.kill()
            await process.wait()

    def tail(self, lines: int = 12) -> str:
        """Return the last lines of the log."""
        with contextlib.suppress(OSError):
            text = (self.folder / f"{self.name}.log").read_text("utf-8", "replace")
            return "\n".join(text.splitlines()[-lines:])
        return ""

    def check(self) -> None:
        """Raise `ProcessExitedError` if the process has exited."""
        if self.process is not None and self.process.returncode is not None:
            message = f"the {self.name} exited with code {self.process.returncode}:\n{self.tail()}"
            raise ProcessExitedError(message)


class Simulator(ChildProcess):
    """Process ``jointfit-sim play``, which reads commands and replies in JSON lines."""

    async def ready(self) -> dict[str, Any]:
        """Wait until the simulated hardware is ready; return its description."""
        async with time_limit(READY_S, "the start of the simulator"):
            while True:
                line = await self.answer()
                if line.get("ready"):
                    return line

    async def send_command(self, command: str) -> None:
        """Send a command."""
        if self.process is None or self.process.stdin is None:
            return
        self.process.stdin.write(command.encode() + b"\n")
        await self.process.stdin.drain()

    async def answer(self) -> dict[str, Any]:
        """Return the next reply."""
        if self.process is None or self.process.stdout is None:
            return {}
        line = await self.process.stdout.readline()
        if not line:
            await self.process.wait()
            self.check()
        answer: dict[str, Any] = orjson.loads(line)
        return answer

    async def quit(self) -> dict[str, Any]:
        """Stop the streams; return the reply with the numbers of sent samples."""
        await self.send_command("quit")
        async with time_limit(STOP_S, "the end of the simulator"):
            while True:
                line = await self.answer()
                if "sent" in line:
                    return line


def simulator(folder: Path, port: int, base: str, options: Sequence[str]) -> Simulator:
    """Return the simulator process; the ``async with`` statement starts it."""
    words = [
        *(sys.executable, "-m", "jointfit_simulators", "play", "--directory", str(folder)),
        *("--mqtt-port", str(port), "--mqtt-base", base, *options),
    ]
    return Simulator("simulator", words, folder, {})


def daemon(folder: Path, rig: Path) -> ChildProcess:
    """Return the daemon process for a rig that the simulator wrote; ``async with`` starts it."""
    words = [sys.executable, "-m", "jointfit_daemon", "--config", str(rig)]
    state = {"STATE_DIRECTORY": str(folder / "state"), "OPENBLAS_NUM_THREADS": "1"}
    return ChildProcess("daemon", words, folder, state)
