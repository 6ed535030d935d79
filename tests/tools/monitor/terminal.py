"""A program in a pseudo-terminal, and the text on its screen.

The terminal understands what Textual sends: text, cursor positions, line ends and erasing.
"""

from __future__ import annotations

import asyncio
import codecs
import contextlib
import fcntl
import os
import re
import struct
import termios
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping, Sequence

_SEQUENCE = re.compile(
    r"\x1b\[([?>=<]?)([\d;:]*)([ -/]*)([@-~])"  # control sequences
    r"|\x1b[\]P_].*?(?:\x07|\x1b\\)|\x1b[()].|\x1b[^\[\]P_()]"  # other sequences have no effect
    r"|([\r\n])|([^\x1b\r\n]+)",
    re.DOTALL,
)
_UNFINISHED = re.compile(r"\x1b(?:\[[?>=<]?[\d;:]*[ -/]*|[\]P_][^\x07\x1b]*)?$")


@dataclass
class Screen:
    """The characters on the screen of a terminal."""

    width: int
    height: int
    received: int = 0
    """Bytes from the program."""
    cells: dict[tuple[int, int], str] = field(default_factory=dict)
    _row: int = 0
    _column: int = 0
    _rest: str = ""
    _decoder: codecs.IncrementalDecoder = field(
        default_factory=lambda: codecs.getincrementaldecoder("utf-8")("replace")
    )

    def feed(self, data: bytes) -> None:
        """Process bytes from the program."""
        self.received += len(data)
        content = self._rest + self._decoder.decode(data)
        cut = _UNFINISHED.search(content)
        self._rest = "" if cut is None else content[cut.start() :]
        for found in _SEQUENCE.finditer(content[: len(content) - len(self._rest)]):
            private, numbers, _, final, line_end, plain = found.groups()
            if plain:
                for character in plain:
                    self.cells[self._row, self._column] = character
                    self._column += 1
            elif line_end == "\r":
                self._column = 0
            elif line_end:
                self._row += 1
            elif final == "H" and not private:
                row, column = [*numbers.split(";"), "1"][:2] if numbers else ("1", "1")
                self._row, self._column = int(row or 1) - 1, int(column or 1) - 1
            elif final == "J" and not private:
                self.cells.clear()

    @property
    def text(self) -> str:
        """Return the lines of the screen."""
        rows = range(self.height)
        return "\n".join(
            "".join(self.cells.get((row, column), " ") for column in range(self.width)).rstrip()
            for row in rows
        )


@dataclass
class TerminalProgram:
    """A running program and its screen."""

    process: asyncio.subprocess.Process
    screen: Screen
    descriptor: int
    arrivals_s: list[float] = field(default_factory=list)
    """Arrival times of the pieces of output, s."""

    def press(self, keys: str) -> None:
        """Send keys."""
        os.write(self.descriptor, keys.encode())

    async def until(self, condition: Callable[[str], object], within_s: float = 60.0) -> str:
        """Wait until the text of the screen meets a condition; return the text."""
        try:
            async with asyncio.timeout(within_s):
                while not condition(self.screen.text):
                    await asyncio.sleep(0.02)
        except TimeoutError:
            raise AssertionError(f"not within {within_s:g} s:\n{self.screen.text}") from None
        return self.screen.text

    async def shows(self, *parts: str, within_s: float = 60.0) -> str:
        """Wait until the screen shows all parts; return its text."""
        return await self.until(lambda text: all(part in text for part in parts), within_s)

    def cpu_s(self) -> float:
        """Return the CPU time of the program, s."""
        status = Path(f"/proc/{self.process.pid}/stat").read_text("utf-8")
        fields = status.rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


@contextlib.asynccontextmanager
async def terminal_program(
    command: Sequence[str], size: tuple[int, int], environment: Mapping[str, str]
) -> AsyncIterator[TerminalProgram]:
    """Run a program in a pseudo-terminal of `size` columns and rows during the ``with`` block."""
    ours, theirs = os.openpty()
    width, height = size
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", height, width, 0, 0))
    process = await asyncio.create_subprocess_exec(
        *command, stdin=theirs, stdout=theirs, stderr=theirs, env=dict(environment),
        start_new_session=True,
    )  # fmt: skip
    os.close(theirs)
    program = TerminalProgram(process, Screen(width, height), ours)
    loop = asyncio.get_running_loop()

    def receive() -> None:
        try:
            data = os.read(ours, 65536)
        except OSError:  # the program has ended, so its terminal is closed
            loop.remove_reader(ours)
            return
        program.arrivals_s.append(time.monotonic())
        program.screen.feed(data)

    loop.add_reader(ours, receive)
    try:
        yield program
    finally:
        if process.returncode is None:
            process.kill()
        await process.wait()
        loop.remove_reader(ours)
        os.close(ours)
