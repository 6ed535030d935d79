"""Command `jointfit init`: asks questions, then writes and checks rig.toml."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import orjson
import typer

from jointfit_daemon.tools.command_group import EXIT_INTERRUPTED, EXIT_MISUSE
from jointfit_daemon.tools.output_files import check_output
from jointfit_daemon.tools.text_output import echo_wrapped

if TYPE_CHECKING:
    from collections.abc import Callable

    from jointfit_daemon.tools.init._answers import Answers
    from jointfit_daemon.tools.init._dialogue import Dialogue
    from jointfit_daemon.tools.init._writing import WrittenRig

PASSWORD_VARIABLE = "JOINTFIT_MQTT_PASSWORD"  # noqa: S105 - its name
"""Environment variable with the password of the broker."""


def init(
    folder: Annotated[
        Path, typer.Argument(help="Folder of the rig.toml, created if missing.")
    ] = Path(),
    *,
    config: Annotated[
        Path | None, typer.Option("--config", help="File to write instead of FOLDER/rig.toml.")
    ] = None,
    answers: Annotated[
        Path | None,
        typer.Option(
            "--answers", help="TOML file with answers; a missing answer takes the proposed value."
        ),
    ] = None,
    port: Annotated[
        list[Path] | None,
        typer.Option("--port", help="Additional serial port for the list of devices; repeatable."),
    ] = None,
    network: Annotated[
        bool, typer.Option(help="Search the network for motion-capture servers.")
    ] = True,
    restart: Annotated[
        bool, typer.Option("--restart", help="Discard the answers of an interrupted dialogue.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace an existing rig.toml.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Ask for limb, sensors, cameras and broker, and write a checked rig.toml.

    The command lists the devices that it finds. The Enter key takes the proposed answer. Without a
    terminal, the lines of standard input are the answers. An interrupted dialogue continues at the
    next start. Exit codes: 0 the file is written; 2 the file exists or cannot be written, or an
    answer is missing; 130 interrupted.
    """
    from jointfit_daemon.tools.init._writing import state_of, write_rig

    path = rig_path(folder, config, force=force)
    state = state_of(path)
    if restart:
        state.unlink(missing_ok=True)

    def show(text: str) -> None:
        echo_wrapped(text, err=json)

    ports = tuple(str(each) for each in port or ())
    dialogue = _new_dialogue(show, state, answers, ports, network=network)
    given = _run_dialogue(dialogue, state)
    password = _write_password(path, given, show)
    written = write_rig(path, given, dialogue.found)
    if json:
        result = {
            "ok": True, "rig": str(path), "password_file": password, "table": written.table,
            "open": written.open_places, "warnings": written.warnings,
            "next": written.next_commands,
        }  # fmt: skip
        typer.echo(orjson.dumps(result, default=str))
        return
    _show_result(written)


def _show_result(written: WrittenRig) -> None:
    if written.open_places:
        echo_wrapped(f"\n{written.path} is written. These values are still missing:")
        for place in written.open_places:
            echo_wrapped(f"  {place}")
    else:
        echo_wrapped(f"\n{written.path} is written and valid.")
    for warning in written.warnings:
        echo_wrapped(f"warning: {warning}")

    echo_wrapped("Next:")
    width = max(map(len, written.next_commands))
    for command, use in written.next_commands.items():
        echo_wrapped(f"  {command:{width}}  {use}")


def _new_dialogue(
    show: Callable[[str], None],
    state: Path,
    answers: Path | None,
    ports: tuple[str, ...],
    *,
    network: bool,
) -> Dialogue:
    """Return a dialogue with the answers of a file or of an interrupted dialogue."""
    from jointfit_daemon.tools.init._answer_file import read_answers, write_answers
    from jointfit_daemon.tools.init._dialogue import Dialogue
    from jointfit_daemon.tools.init._search import DeviceSearch

    prepared = {} if answers is None else read_answers(answers)
    stored = read_answers(state) if state.exists() and answers is None else None
    search = DeviceSearch(show, ports, network)
    dialogue = Dialogue(
        search,
        show,
        _reader(show),
        lambda given: write_answers(state, given),
        search.start(),
        prepared,
        is_script=answers is not None,
    )
    _show_found(dialogue, show)
    if stored is not None:
        show(f"Continuing with the answers in {state} (--restart begins again)")
        dialogue.resume(stored)
    elif answers is None:
        show("Enter takes the proposal in brackets, '?' explains, '<' goes back one question")
    return dialogue


def rig_path(folder: Path, config: Path | None = None, *, force: bool = False) -> Path:
    """Return the path of the new rig.toml; create its folder if necessary.

    Raises
    ------
    ValueError
        The file exists and `force` is False, or the file cannot be written.
    """
    path = folder / "rig.toml" if config is None else config
    if config is None:
        folder.mkdir(parents=True, exist_ok=True)
    check_output("rig.toml" if config is None else "--config", path, (".toml",))
    if path.exists() and not force:
        raise ValueError(f"{path} exists: replace it with --force, or choose another folder")
    return path


def _reader(show: Callable[[str], None]) -> Callable[[str], str]:
    """Return a function that prints a prompt and reads a line of standard input."""
    is_terminal = sys.stdin.isatty()

    def read_line(prompt: str) -> str:
        if is_terminal:
            typer.echo(prompt, nl=False, err=True)
        line = sys.stdin.readline()
        if not line:
            raise EOFError
        if not is_terminal:
            show(f"{prompt}{line.rstrip()}")
        return line

    return read_line


def _show_found(dialogue: Dialogue, show: Callable[[str], None]) -> None:
    found = dialogue.found
    devices = (*found.ports, *found.interfaces, *found.servers)
    if not devices:
        show("No serial port, CAN interface or motion-capture server was found.")
        show("You may type the names of devices, or connect devices and start again.")
        return
    show("Found devices:")
    width = max(len(each.address) for each in devices)
    for each in devices:
        show(f"  {each.address:{width}}  {each.text}")


def _run_dialogue(dialogue: Dialogue, state: Path) -> Answers:
    """Run the dialogue; after an interruption, report the command that continues it."""
    from jointfit_daemon.tools.init._dialogue import UnansweredError

    try:
        return dialogue.run()
    except KeyboardInterrupt:
        code, reason = EXIT_INTERRUPTED, "interrupted"
    except EOFError:
        code, reason = EXIT_MISUSE, "the input ended before the last question"
    except UnansweredError as error:
        code, reason = EXIT_MISUSE, str(error)
    kept = f"{len(dialogue.known)} answers are in {state}; the same command continues with them"
    typer.echo(f"\njointfit init: {reason}\n{kept}", err=True)
    raise typer.Exit(code)


def _write_password(path: Path, given: Answers, show: Callable[[str], None]) -> str | None:
    """Write the broker's password; return the path of its file, or None if no file is needed."""
    from jointfit_daemon.tools.init._writing import write_password

    name = given.get(("password_file", ""))
    if name is None:
        return None
    file = path.absolute().parent / name
    if file.exists():
        show(f"The password in {file} is used.")
        return str(file)
    password = os.environ.get(PASSWORD_VARIABLE)
    if not password and sys.stdin.isatty():
        password = typer.prompt("Password for the broker", hide_input=True, err=True)
    if not password:
        return str(file)  # without a password, the check warns that the file is missing
    write_password(file, password)
    return str(file)
