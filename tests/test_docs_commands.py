"""Every command of a page is run as printed, on sample data, with the services that it needs.

Two things differ from a reader's machine. The broker listens on a free port, which is passed to
mosquitto's clients and to ``jointfit-sim play``. The phases of a calibration are short.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from jointfit_daemon.files.models import read_model
from tests.documented_commands import (
    PLACEHOLDER,
    Block,
    PageFile,
    Shell,
    commands,
    disagreement,
    options_of,
    page_parts,
    reason_not_to_run,
    uncommanded,
)
from tests.test_docs import PAGES, ROOT, blocks, every_page, text_of

if TYPE_CHECKING:
    from tests.broker_fixture import Broker

COMMANDS = re.compile(
    r"^ *(jointfit|jointfitd|jointfit-sim|python|make|sudo|pip|mosquitto_\w+) ", re.MULTILINE
)
IN_SAMPLE = "`jointfit sample sample && cd sample`"
"""Pages with these words are read in the folder of sample data."""
SHORT_PHASES = "--align-s 5 --static-s 2 --functional-s 8"
STARTED = re.compile(r"\$\(([\w-]+)|^(?:\w+=[^ (]* )*([\w-]+) ")
"""The first program of a command, after or within assignments."""
TESTED_PROGRAMS = {
    "jointfit", "jointfitd", "jointfit-sim", "mosquitto_pub", "mosquitto_sub", "openssl",
    "awk", "cd", "head", "printf", "python", "sleep",
}  # fmt: skip
"""Programs that a test of a page may start. If a page needs another program, add the program here.
If no test can run the command, such as one for the service manager, add a reason to `NOT_RUN`.
"""
MAN_PAGES = sorted((ROOT / "packaging" / "man").glob("*.1"))


def blocks_of(page: Path) -> list[Block]:
    return [part for part in page_parts(text_of(page)) if isinstance(part, Block)]


def runnable(page: Path) -> bool:
    return any(
        reason_not_to_run(command) is None
        for block in blocks_of(page)
        for command in block.commands
    )


def environment(home: Path) -> dict[str, str]:
    """Return the environment of a reader who has activated the virtual environment."""
    path = os.pathsep.join(
        [str(home / "bin"), str(Path(sys.executable).parent), os.environ["PATH"]]
    )
    return os.environ | {
        "HOME": str(home),
        "PATH": path,
        "LC_ALL": "C.UTF-8",
        "COLUMNS": "160",
    }


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder in which `jointfit sample sample` was run."""
    folder = tmp_path_factory.mktemp("reader")
    subprocess.run(
        ["jointfit", "sample", "sample"], cwd=folder, env=environment(folder), check=True,
        capture_output=True,
    )  # fmt: skip
    return folder / "sample"


def shorten_simulations(broker: Broker, home: Path, phases: str = SHORT_PHASES) -> None:
    """Install a `jointfit-sim` that calls the real one with the broker's port and short phases."""
    real = shutil.which("jointfit-sim", path=environment(ROOT)["PATH"])
    options = f"--mqtt-host {broker.host} --mqtt-port {broker.port} {phases}"
    (home / "bin").mkdir()
    program = home / "bin" / "jointfit-sim"
    program.write_text(
        f'#!/bin/sh\nif [ "$1" = play ]; then exec {real} "$@" {options}; fi\nexec {real} "$@"\n',
        encoding="utf-8",
    )
    program.chmod(0o755)


def point_clients_at(broker: Broker, home: Path) -> None:
    """Write the port of the broker to the option files of mosquitto's clients."""
    (home / ".config").mkdir()
    for program in ("mosquitto_sub", "mosquitto_pub"):
        options = f"-h {broker.host}\n-p {broker.port}\n-V mqttv5\n"
        (home / ".config" / program).write_text(options, encoding="utf-8")


@pytest.mark.experiment
@pytest.mark.system
@pytest.mark.timeout(900)
@pytest.mark.skipif(
    shutil.which("jointfit", path=environment(ROOT)["PATH"]) is None,
    reason="the commands are not installed in this environment: make .venv/.installed",
)
@pytest.mark.parametrize(
    "page", [page for page in PAGES if runnable(page)], ids=lambda page: page.name
)
def test_every_command_of_a_page_runs_as_printed(
    page: Path, broker: Broker, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    home, reader, logs = tmp_path / "home", tmp_path / "reader", tmp_path / "logs"
    for folder in (home, reader, logs):
        folder.mkdir()
    if IN_SAMPLE in " ".join(text_of(page).split()):
        shutil.copytree(request.getfixturevalue("sample"), reader, dirs_exist_ok=True)
    if "git clone" in text_of(page):
        (reader / "examples").symlink_to(ROOT / "examples")
    point_clients_at(broker, home)
    shorten_simulations(broker, home)

    with Shell(reader, environment(home), logs) as shell:
        for part in page_parts(text_of(page)):
            if isinstance(part, PageFile):
                (reader / part.name).write_text(part.text, encoding="utf-8")
                continue
            printed = ""
            for command in part.commands:
                if reason_not_to_run(command) is None:
                    printed += shell.run(command)
            if part.output is not None:
                assert disagreement(part.output, printed) is None, printed
        shell.stop_services()


@every_page
def test_commands_are_fenced_as_commands_and_hold_no_placeholder(page: Path) -> None:
    for block in blocks_of(page):
        assert [c for c in block.commands if PLACEHOLDER.search(c)] == []

    others = uncommanded(text_of(page))
    assert [body for body in others if COMMANDS.search(body)] == []


def bench_commands() -> dict[str, set[str]]:
    """Return the options that pages give to each program of bench."""
    found: dict[str, set[str]] = {}
    for page in PAGES:
        for block in blocks_of(page):
            for command in block.commands:
                if program := re.search(r"python -m (bench[\w.]*)", command):
                    found.setdefault(program[1], set()).update(options_of(command))
    return found


@pytest.mark.parametrize("program", sorted(bench_commands()))
def test_bench_program_has_the_options_of_the_pages(program: str) -> None:
    helped = subprocess.run(
        [sys.executable, "-m", program, "--help"],
        cwd=ROOT,
        env=environment(ROOT) | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=True,
    )
    assert [option for option in bench_commands()[program] if option not in helped.stdout] == []


@pytest.mark.parametrize("page", MAN_PAGES, ids=lambda page: page.name)
def test_a_man_page_names_options_and_commands_that_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8").replace("\\-", "-").replace("\\", "")
    module = {"jointfit": "jointfit_daemon.tools", "jointfitd": "jointfit_daemon"}
    words = [sys.executable, "-m", module.get(page.stem, "jointfit_simulators")]
    wide = environment(ROOT) | {"PYTHONPATH": os.pathsep.join(sys.path)}

    def helped() -> str:
        line = [*words, "--help"]
        return subprocess.run(line, env=wide, capture_output=True, text=True, check=True).stdout

    named = re.findall(r'^\.TP\n\.BI? "?([a-z-]+)', text, re.MULTILINE)
    options, subcommands = (
        [n for n in named if n.startswith("-")],
        [n for n in named if n[0] != "-"],
    )
    overview = helped()
    if page.stem == "jointfit":
        assert subcommands
        assert [name for name in subcommands if not re.search(rf"\b{name}\b", overview)] == []
    assert [name for name in options if name not in overview] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_run_by_the_tests_start_only_programs_that_every_machine_can_run(
    page: Path,
) -> None:
    started = {
        found[1] or found[2]
        for block in blocks_of(page)
        for command in block.commands
        if reason_not_to_run(command) is None and (found := STARTED.search(command)) is not None
    }
    assert started <= TESTED_PROGRAMS


def test_a_difference_in_the_printed_output_is_noticed() -> None:
    printed = "method  sphere\n\nerror  13.1 mm of T1\narc  103°\n"
    assert disagreement("method sphere\nerror  13.2 mm of T1\narc  103°", printed) is None
    assert disagreement("method sphere\n…\narc  103°", printed) is None
    assert disagreement("method sphere\narc  103°", printed) == "arc  103°"
    assert disagreement("…\nerror  14.1 mm of T1", printed) == "error  14.1 mm of T1"
    assert disagreement("…\nerror  13.1 mm of T2", printed) == "error  13.1 mm of T2"


def test_commands_come_without_comments_and_in_one_piece() -> None:
    body = "a --b 'c#d'   # why\n# nothing\nmake \\\n    demo\n"
    assert list(commands(body)) == ["a --b 'c#d'", "make      demo"]


def test_a_command_that_fails_is_noticed(tmp_path: Path) -> None:
    with Shell(tmp_path, environment(tmp_path), tmp_path) as shell:
        shell.run("mkdir here && cd here")
        with pytest.raises(AssertionError, match="exit code 3"):
            shell.run("test $(basename $PWD) = here && (exit 3)")


def test_the_chain_model_of_the_kinematics_page_loads(tmp_path: Path) -> None:
    shown = blocks(ROOT / "docs" / "kinematics.md", "toml")
    for number, text in enumerate(body for body in shown if "[[marker]]" in body):
        file = tmp_path / f"{number}.toml"
        file.write_text(text, encoding="utf-8")
        assert read_model(file).markers
