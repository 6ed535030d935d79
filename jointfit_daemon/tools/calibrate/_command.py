"""`jointfit calibrate`: leads through a calibration of a running daemon, over MQTT.

Invariants: only the result goes to stdout; prompts, progress and warnings go to stderr. A phase
that this command started does not outlive it, unless the broker or the daemon is gone.
"""

from __future__ import annotations

import asyncio
import math
import sys
from contextlib import asynccontextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jointfit_daemon.tools.command_group import EXIT_FAILED

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping, Sequence

    from rich.console import Console

    from jointfit_daemon.config import Rig
    from jointfit_daemon.outputs.mqtt import MqttClient
    from jointfit_daemon.tools.calibrate._phase_tracker import CalibrationWatch
    from jointfit_daemon.tools.stop_signals import StopRequest

NOT_TAKEN = 3
ABORT_S = 2.0
"""Time for the daemon to answer an abort before the command ends without it."""
LONGEST_S = 600.0
ORDER = ("align", "static", "functional")
AT_ONCE = {
    "abort": "aborted; in force: ",
    "unlearn": "what was learned while running is taken back; in force: ",
}
SAYS = {
    "align": "Fix all sensors on the plate and turn it by hand about all axes.",
    "static": "Put everything on. Stand still and upright.",
    "functional": "Move every joint: walk, squat, sit down and stand up, circle the hip.",
}
TOPICS = ("calibration", "calibration/progress", "bridge/event", "bridge/state")


class NobodyThere(ValueError):  # noqa: N818 - named for what happened
    """Standard input has ended: nobody can press Enter."""

    def __init__(self) -> None:
        super().__init__("nobody can press Enter here: use --yes")


class OutputLostError(Exception):
    """Standard error cannot be written any more: the terminal or the reader of the pipe is gone."""


class StoppedError(Exception):
    """A stop signal ended the command."""

    def __init__(self, request: StopRequest) -> None:
        super().__init__(f"stopped by {request.name}")
        self.exit_code = request.exit_code


def calibrate(
    config: Annotated[Path, typer.Argument(help="The rig.toml of the daemon.")] = Path("rig.toml"),
    *,
    phase: Annotated[
        list[str] | None,
        typer.Option(
            help="align, static, functional, abort or unlearn; may be given several times. "
            "Default: static, then functional where there is motion capture."
        ),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(help="Length of each phase, s; default: as in rig.toml.", max=LONGEST_S),
    ] = None,
    abort: Annotated[
        bool, typer.Option("--abort", help="End the phase that is running, whoever started it.")
    ] = False,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the stored calibration even by a worse one.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before each phase.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the last status as JSON.")] = False,
) -> None:
    """Lead through a calibration of the running daemon; Ctrl-C or SIGTERM aborts the phase.

    Exit codes: 0 done; 1 no broker, no daemon, or a phase was refused or aborted; 2 wrong options
    or rig.toml; 3 the result is worse than the stored one, which stays in force (--force replaces
    it); 128 + N stopped by signal N, after the phase was aborted.
    """
    from jointfit_daemon.config import load_rig

    wrong = [name for name in phase or () if name not in (*ORDER, *AT_ONCE)]
    if wrong:
        raise ValueError(f"--phase {wrong[0]}: expected one of {', '.join((*ORDER, *AT_ONCE))}")
    if seconds is not None and not (math.isfinite(seconds) and seconds > 0.0):
        raise ValueError(f"--seconds {seconds:g}: expected 0 < seconds <= {LONGEST_S:g}")

    rig = load_rig(config)
    default = ORDER[1:] if any(s.kind == "mocap" for s in rig.sources) else ("static",)
    phases = ("abort",) if abort else phase or default
    try:
        status = asyncio.run(_lead(rig, phases, seconds, config, force=force, ask=not yes))
    except StoppedError as stopped:
        raise typer.Exit(stopped.exit_code) from None
    except OutputLostError:
        raise typer.Exit(EXIT_FAILED) from None
    _tell(status, json=json)


def _tell(status: Mapping[str, Any], *, json: bool) -> None:
    """Print the last status; end with `NOT_TAKEN` if its result was not."""
    import orjson

    from jointfit_daemon.tools.calibrate._report import report

    if json:
        typer.echo(orjson.dumps(status))
    else:
        for line in (str(status.get("text", "done")), *report(status.get("quality") or {})):
            typer.echo(line)
    if status.get("kept") is not None:
        typer.echo(f"jointfit calibrate: not taken: {status['kept']}", err=True)
        raise typer.Exit(NOT_TAKEN)


async def _lead(
    rig: Rig,
    phases: Sequence[str],
    seconds: float | None,
    config: Path,
    *,
    force: bool,
    ask: bool,
) -> dict[str, Any]:
    from rich.console import Console

    from jointfit_daemon.outputs.mqtt import MqttClient
    from jointfit_daemon.tools.stop_signals import cancel_on_signal

    console = Console(stderr=True)
    status: dict[str, Any] = {}
    with cancel_on_signal() as stop:
        try:
            async with MqttClient(rig.mqtt) as client:
                await client.subscribe(*TOPICS)
                for name in phases:
                    if ask and name in SAYS:
                        console.print(f"{SAYS[name]} Enter to begin: ", end="", soft_wrap=True)
                        await _enter()
                    arguments: dict[str, object] = {"phase": name, "force": force}
                    if seconds is not None:
                        arguments["seconds"] = seconds
                    async with _watching(client, console) as watch:
                        status = await _phase(client, watch, arguments, config)
        except asyncio.CancelledError:
            if stop.number is None:
                raise
            _note(f"jointfit calibrate: stopped by {stop.name}")
            raise StoppedError(stop) from None
    return status


async def _phase(
    client: MqttClient, watch: CalibrationWatch, arguments: dict[str, object], config: Path
) -> dict[str, Any]:
    from jointfit_daemon.tools.calibrate._phase_tracker import RequestRefused

    name = str(arguments["phase"])
    watch.begin()
    # a task of its own: its answer is needed even if a signal cancels this one meanwhile
    asked = asyncio.create_task(client.request("calibrate", arguments), name="calibrate request")
    try:
        answer = await asyncio.shield(asked)
        if answer.get("status") == "error":
            raise RequestRefused(str((answer.get("error") or {}).get("message")))
        if name in AT_ONCE:
            return {"text": AT_ONCE[name] + str(answer.get("data", {}).get("phase"))}
        ended = await watch.ended(name)
    except (asyncio.CancelledError, OutputLostError):
        if name not in AT_ONCE:
            await _abort_phase(client, name, asked, config)
        raise
    final = name == "align" or ended.get("kept") is not None
    return dict(ended if final else await watch.stored(ended))


async def _abort_phase(
    client: MqttClient, name: str, asked: asyncio.Task[dict[str, Any]], config: Path
) -> None:
    """Abort the phase that this command started, and report the outcome; another's is left alone.

    Requests run as tasks of their own because this one is already cancelled.
    """
    await asyncio.wait([asked], timeout=ABORT_S)
    started = asked.done() and not asked.cancelled() and asked.exception() is None
    if started and asked.result().get("status") == "error":
        return

    ending = asyncio.create_task(client.request("calibrate", {"phase": "abort"}), name="abort")
    await asyncio.wait([ending], timeout=ABORT_S)
    if ending.done() and not ending.cancelled() and ending.exception() is None:
        _note(f"{name}: aborted")
    else:
        ending.cancel()
        _note(
            f"{name}: the daemon did not answer the abort within {ABORT_S:g} s, so the phase may"
            f" still be running. To end it: jointfit calibrate {config} --abort"
        )


def _note(text: str) -> None:
    """Print a line on standard error, which may be gone."""
    with suppress(OSError):
        typer.echo(text, err=True)


@asynccontextmanager
async def _watching(client: MqttClient, console: Console) -> AsyncIterator[CalibrationWatch]:
    """Show the progress of the daemon: as a bar on a terminal, else as lines now and then."""
    from rich.console import Group
    from rich.live import Live
    from rich.progress import Progress
    from rich.text import Text

    from jointfit_daemon.tools.calibrate._phase_tracker import CalibrationWatch
    from jointfit_daemon.tools.calibrate._report import ProgressLines, movement_lines

    bar, joints, lines = Progress(console=console), Text(), ProgressLines()
    task = bar.add_task("", total=1.0)
    screen = Live(Group(bar, joints), console=console, transient=True, auto_refresh=False)
    with screen if console.is_terminal else nullcontext():

        def show(name: str, done: float, text: str) -> None:
            bar.update(task, completed=done, description=name)
            joints.plain = text
            lines.update(name, done, text)

        def figures(data: Mapping[str, Any]) -> None:
            if console.is_terminal:
                joints.plain = "\n".join((joints.plain, *movement_lines(data)))
                screen.refresh()
                return
            for line in lines.due(asyncio.get_running_loop().time(), data):
                typer.echo(line, err=True)

        watch = CalibrationWatch(show, figures)
        listening = asyncio.create_task(_listen(client, watch, console), name="calibrate listener")
        try:
            yield watch
        finally:
            listening.cancel()
            await asyncio.wait([listening])


async def _listen(client: MqttClient, watch: CalibrationWatch, console: Console) -> None:
    from jointfit_daemon.outputs.mqtt import BrokerLostError

    try:
        async for topic, payload in client.messages():
            if isinstance(payload, dict) and (line := _heard(watch, topic, payload)):
                console.print(line, markup=False, highlight=False, soft_wrap=True)
    except BrokerLostError as lost:
        watch.lose(lost)
    except (OSError, SystemExit) as gone:  # rich turns a broken pipe into SystemExit
        watch.lose(OutputLostError(str(gone)))


def _heard(watch: CalibrationWatch, topic: str, payload: dict[str, Any]) -> str | None:
    """Tell `watch` what came; return what a person must read at once."""
    from jointfit_daemon.tools.calibrate._phase_tracker import PhaseAborted

    text = str(payload.get("text", ""))
    if topic == "calibration":
        watch.on_status(payload)
        return None if sys.stderr.isatty() else f"{payload.get('phase')}: {text}"
    if topic == "calibration/progress":
        watch.on_progress(payload)
    elif topic == "bridge/state" and payload.get("state") != "online":
        watch.lose(PhaseAborted("the daemon is not running, or lost its broker"))
    elif topic == "bridge/event" and _matters(payload):
        if text == watch.status.get("text") and not sys.stderr.isatty():
            return None  # printed with the status
        return f"{payload.get('id')}: {text}"
    return None


def _matters(event: dict[str, Any]) -> bool:
    level = ("warning", "error") if event.get("kind") == "device" else ("error",)
    return event.get("kind") in ("device", "calibration") and event.get("level") in level


async def _enter() -> None:
    """Wait for a line on standard input, in a way that Ctrl-C can end.

    Raises
    ------
    NobodyThere
        Standard input is closed, or is nothing that can be waited for.
    """
    loop, pressed = asyncio.get_running_loop(), asyncio.Event()
    try:
        loop.add_reader(sys.stdin, pressed.set)
    except (OSError, ValueError) as nobody:
        raise NobodyThere from nobody
    try:
        await pressed.wait()
    finally:
        loop.remove_reader(sys.stdin)
    if not sys.stdin.readline():
        raise NobodyThere
