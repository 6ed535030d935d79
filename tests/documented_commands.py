"""The commands that a page prints, and a shell that runs them as printed.

A fence ```` ```sh ```` contains commands. A fence ```` ```text ```` directly below it contains
their output: lines of stdout in order, ``…`` for omitted lines, numbers within 2 %. A TOML fence
whose first line is ``# NAME.toml`` is the file of that name.
"""

from __future__ import annotations

import re
import select
import shlex
import shutil
import subprocess
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping, Sequence
    from pathlib import Path
    from types import TracebackType
    from typing import Self

FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
COMMENT = re.compile(r"(?:^|\s+)# .*$")
PLACEHOLDER = re.compile(r"…|\.\.\.|<[a-z][a-z-]*>|\b(?:DIR|FILE|NAME|PATH|RUN|SERIAL|TRIAL)\b")
NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?")
LEAST_AGREEMENT = 0.02
"""Largest accepted relative difference of a printed number, because other processors round
differently. Two units of the last printed digit are also accepted."""
COMMAND_S = 240.0
"""Time limit of one command, s. On an idle machine, no command needs a tenth of it."""

SERVICES = re.compile(r"jointfitd --config|jointfit-sim play|mosquitto_sub")
"""Commands that run until they are stopped."""
READY = {"jointfitd": "connected to", "jointfit-sim": '"ready":true'}
"""Text that a service prints when it is ready, by service. Other services are ready at once."""
OPTIONAL_PROGRAMS = ("mosquitto_sub", "mosquitto_pub", "openssl")
"""Programs whose commands run only if the programs are installed."""

NOT_RUN = {
    r"\b(sudo|sudoedit|systemctl|journalctl) |apt ": "needs root and systemd: tests/vm_service",
    r"/etc/|^chown |^mosquitto_passwd ": "needs root: changes an installed broker or service",
    r"^\. \.venv/": "the environment of the tests has the programs already",
    r"^git clone |pip install |^pipx ": "needs the network",
    r"^make ": "minutes of processor time: CI runs the targets",
    r"python -m bench": "minutes of processor time: the options are checked against its --help",
    r"pytest": "the test suite itself",
    r"examples/jointfit-example-driver": "changes the environment: tests/drivers installs it",
    r"examples/subscribers|http.server": "runs until it is stopped: tests/examples",
    r"^telegraf ": "is not in Debian: tests/examples evaluates its configuration",
    r"^colcon |^ros2 ": "needs ROS 2: tests/examples runs the bridge with a stand-in",
    r"^curl ": "needs [metrics] on port 9464: tests/outputs/metrics starts it on a free one",
    r"^jointfit init ": "asks questions: tests/tools/init answers them",
    r"^jointfit dashboard": "needs port 8080: tests/tools/dashboard starts it on a free one",
    r"^jointfit monitor": "needs a terminal: tests/system runs it in a pseudo-terminal",
    r"^jointfit doctor": "finds the faults of the test machine: tests/tools/doctor runs it",
    r"^jointfit center-study": "12 s of processor time",
    r"^jointfit report ": "needs a recording: tests/tools/report makes one",
    r"^jointfit batch ": "needs recordings: tests/tools/batch makes some",
    r"^dask ": "runs until it is stopped: tests/tools/batch starts a cluster",
    r"SHA256SUMS": "needs the files of a release: tests/packaging/test_release.py makes one",
    r"/dev/|^candump |^ip link|^udevadm ": "needs hardware",
}
"""Patterns of commands that a test cannot run, each with the reason."""


class Block(NamedTuple):
    """One fence of commands, with their output on the page."""

    commands: tuple[str, ...]
    output: str | None


class PageFile(NamedTuple):
    """A file that the page shows."""

    name: str
    text: str


def page_parts(text: str) -> Iterator[Block | PageFile]:
    """Yield command blocks and files in the order of the page."""
    for fence in FENCE.finditer(text):
        language, body = fence[2], _dedented(fence[3], len(fence[1]))
        if language == "sh":
            after = FENCE.match(text, fence.end() + 1)
            printed = after[3] if after is not None and after[2] == "text" else None
            yield Block(tuple(commands(body)), printed)
        elif language == "toml" and (name := re.match(r"# ([\w-]+\.toml)\n", body)):
            yield PageFile(name[1], body)


def uncommanded(text: str) -> list[str]:
    """Return the contents of all fences that have no language or the language ``text``."""
    return [fence[3] for fence in FENCE.finditer(text) if fence[2] in {"", "text"}]


def _dedented(body: str, width: int) -> str:
    return "\n".join(line[width:] for line in body.splitlines()) + "\n"


def commands(body: str) -> Iterator[str]:
    """Yield each command of a block on one line, without its comment."""
    for line in body.replace("\\\n", " ").splitlines():
        if command := COMMENT.sub("", line).strip():
            yield command


def reason_not_to_run(command: str) -> str | None:
    """Return why a test cannot run this command; None if it can."""
    for pattern, reason in NOT_RUN.items():
        if re.search(pattern, command):
            return reason
    absent = [word for word in OPTIONAL_PROGRAMS if word in command and not shutil.which(word)]
    return f"{absent[0]} is not installed" if absent else None


def disagreement(expected: str, printed: str) -> str | None:
    """Return the first expected line that is missing in the output; None if none is missing."""
    lines = [line.split() for line in printed.splitlines() if line.strip()]
    place, anywhere = 0, False
    for line in filter(str.strip, expected.splitlines()):
        if line.strip() == "…":
            anywhere = True
            continue
        found = next(
            (at for at in range(place, len(lines)) if _agree(line.split(), lines[at])), None
        )
        if found is None or (found != place and not anywhere):
            return line
        place, anywhere = found + 1, False
    return None


def _agree(expected: Sequence[str], printed: Sequence[str]) -> bool:
    return len(expected) == len(printed) and all(map(_same_word, expected, printed))


def _same_word(expected: str, printed: str) -> bool:
    if NUMBER.sub("#", expected) != NUMBER.sub("#", printed):
        return False
    pairs = zip(NUMBER.findall(expected), NUMBER.findall(printed), strict=True)
    return all(_near(a, b) for a, b in pairs)


def _near(expected: str, printed: str) -> bool:
    digits = len(expected.partition(".")[2])
    allowed = max(LEAST_AGREEMENT * abs(float(expected)), 2.01 * 10**-digits)
    exact = digits == 0 and abs(float(expected)) < 10  # a count, or a name such as T1
    return expected == printed if exact else abs(float(expected) - float(printed)) <= allowed


@dataclass
class Shell:
    """A bash session, as a reader of a page uses it; services run until the end."""

    folder: Path
    environment: Mapping[str, str]
    logs: Path
    _services: list[tuple[str, str, Path]] = field(default_factory=list)
    _number: int = 0

    def __enter__(self) -> Self:
        """Start bash."""
        self._process = subprocess.Popen(
            ["bash", "--noprofile", "--norc"],
            cwd=self.folder,
            env=dict(self.environment),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Kill the remaining services, close the input of bash, and wait until bash ends."""
        for _, pid, _ in self._services:
            self._ask(f"kill -KILL {pid}; echo")
        self._process.communicate(timeout=COMMAND_S)

    def run(self, command: str) -> str:
        """Run a command or start a service; return its output on stdout."""
        if SERVICES.match(command):
            self._start(command.removesuffix("&").strip())
            return ""
        out, err = self._files()
        # A command that waits for the Enter key receives new lines.
        code = self._ask(f"{{ {command}\n}} >{out} 2>{err} < <(yes '')\necho $?")
        said = out.read_text("utf-8", "replace")
        assert code == "0", f"{command}\nexit code {code}\n{said}{err.read_text()}"
        return said

    def stop_services(self) -> None:
        """Stop the services in reverse order; each must stop on request."""
        while self._services:
            command, pid, err = self._services.pop()
            code = self._ask(f"kill -TERM {pid}; wait {pid}; echo $?")
            if not command.startswith("mosquitto_sub"):
                assert code == "0", f"{command}\nexit code {code}\n{err.read_text()}"

    def _start(self, command: str) -> None:
        out, err = self._files()
        pid = self._ask(f"(exec {command}) >{out} 2>{err} </dev/null &\necho $!")
        self._services.append((command, pid, err))
        sign = READY.get(command.split(maxsplit=1)[0], "")
        until = time.monotonic() + COMMAND_S
        while sign not in out.read_text() + err.read_text():
            assert time.monotonic() < until, f"{command}: not ready\n{err.read_text()}"
            time.sleep(0.05)

    def _files(self) -> tuple[Path, Path]:
        self._number += 1
        files = self.logs / f"{self._number}.out", self.logs / f"{self._number}.err"
        for file in files:
            file.touch()
        return files

    def _ask(self, script: str) -> str:
        """Send bash a script that prints one line; return this line."""
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write(script + "\n")
        stdin.flush()
        ready, _, _ = select.select([stdout], [], [], COMMAND_S)
        assert ready, f"no end within {COMMAND_S:g} s: {script}"
        return stdout.readline().strip()


def options_of(command: str) -> set[str]:
    """Return the long options of a command."""
    return {word.partition("=")[0] for word in shlex.split(command) if word.startswith("--")}
