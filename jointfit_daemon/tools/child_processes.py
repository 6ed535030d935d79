"""The processes of a demo: virtual hardware and the real daemon. Law: starts, talks, stops."""

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
    from types import TracebackType

READY_S = 30.0  # a Raspberry Pi imports scipy in ten
STOP_S = 10.0


class ProcessEnded(Exception):  # noqa: N818 - named for what happened
    """A process of the demo ended on its own; the text is the end of what it said."""


class DemoTimeoutError(Exception):
    """A step of the demo took too long; the message says which, and what to do."""


@contextlib.asynccontextmanager
async def finished_within(seconds: float, step: str) -> AsyncIterator[None]:
    """Bound the time of a step.

    Raises
    ------
    DemoTimeoutError
        The block took longer than `seconds`.
    """
    try:
        async with asyncio.timeout(seconds):
            yield
    except TimeoutError as late:
        raise DemoTimeoutError(
            f"{step} took longer than {seconds:g} s: is the machine busy? Try again, or look into"
            " the logs with --keep FOLDER"
        ) from late


@dataclass(slots=True)
class Child:
    """One process, its words kept in a file."""

    name: str
    words: Sequence[str]
    folder: Path
    environment: dict[str, str]
    process: asyncio.subprocess.Process | None = None

    async def __aenter__(self) -> Self:
        """Start it."""
        with (self.folder / f"{self.name}.log").open("wb") as log:
            self.process = await asyncio.create_subprocess_exec(
                *self.words,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE if self.name == "simulator" else log,
                stderr=log,
                env=os.environ | self.environment,
                limit=1 << 20,
            )
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Terminate it; kill it if it does not end."""
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
        """Return the end of what it said."""
        with contextlib.suppress(OSError):
            text = (self.folder / f"{self.name}.log").read_text("utf-8", "replace")
            return "\n".join(text.splitlines()[-lines:])
        return ""

    def check(self) -> None:
        """Raise ProcessEnded if it is gone."""
        if self.process is not None and self.process.returncode is not None:
            message = f"the {self.name} ended with {self.process.returncode}:\n{self.tail()}"
            raise ProcessEnded(message)


class Simulator(Child):
    """``jointfit-sim play``: told what to do on its standard input, answers in JSON lines."""

    async def ready(self) -> dict[str, Any]:
        """Wait until the virtual hardware is there; return where it is."""
        async with finished_within(READY_S, "the start of the simulator"):
            while True:
                line = await self.answer()
                if line.get("ready"):
                    return line

    async def say(self, command: str) -> None:
        """Give a command."""
        if self.process is None or self.process.stdin is None:
            return
        self.process.stdin.write(command.encode() + b"\n")
        await self.process.stdin.drain()

    async def answer(self) -> dict[str, Any]:
        """Return its next line."""
        if self.process is None or self.process.stdout is None:
            return {}
        line = await self.process.stdout.readline()
        if not line:
            await self.process.wait()
            self.check()
        answer: dict[str, Any] = orjson.loads(line)
        return answer

    async def quit(self) -> dict[str, Any]:
        """Stop the streams; return what was sent."""
        await self.say("quit")
        async with finished_within(STOP_S, "the end of the simulator"):
            while True:
                line = await self.answer()
                if "sent" in line:
                    return line


def simulator(folder: Path, port: int, base: str, options: Sequence[str]) -> Simulator:
    """Return the virtual hardware of the demo, not started yet."""
    words = [
        *(sys.executable, "-m", "jointfit_simulators", "play", "--directory", str(folder)),
        *("--mqtt-port", str(port), "--mqtt-base", base, *options),
    ]
    return Simulator("simulator", words, folder, {})


def daemon(folder: Path, rig: Path) -> Child:
    """Return the real daemon on the rig that the simulator wrote, not started yet."""
    words = [sys.executable, "-m", "jointfit_daemon", "--config", str(rig)]
    state = {"STATE_DIRECTORY": str(folder / "state"), "OPENBLAS_NUM_THREADS": "1"}
    return Child("daemon", words, folder, state)
