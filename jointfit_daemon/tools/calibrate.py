"""`jointfit calibrate`: leads through a calibration of a running daemon, over MQTT.

Law: the result alone goes to stdout; prompts, progress and warnings go to stderr.
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import asynccontextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping, Sequence

    from rich.console import Console

    from jointfit_daemon.config import Rig
    from jointfit_daemon.outputs.mqtt_client import MqttClient
    from jointfit_daemon.tools.calibration_guide import CalibrationWatch

MISUSE, NOT_TAKEN = 2, 3
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


class NobodyThere(Exception):  # noqa: N818 - named for what happened
    """Standard input has ended: nobody can press Enter."""


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
    force: Annotated[
        bool, typer.Option("--force", help="Replace the stored calibration even by a worse one.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before each phase.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the last status as JSON.")] = False,
) -> None:
    """Lead through a calibration of the running daemon; Ctrl-C ends the phase.

    Exit code 1: a phase was refused or given up; 3: the result is worse than what is stored, which
    stays (--force takes it).
    """
    from jointfit_daemon.config import ConfigError, load_rig
    from jointfit_daemon.outputs.mqtt import BrokerLost
    from jointfit_daemon.outputs.mqtt_client import NoAnswer
    from jointfit_daemon.tools.calibration_guide import PhaseAborted, RequestRefused

    wrong = [name for name in phase or () if name not in (*ORDER, *AT_ONCE)]
    if wrong:
        typer.echo(f"--phase {wrong[0]}: expected one of {', '.join((*ORDER, *AT_ONCE))}", err=True)
        raise typer.Exit(MISUSE)
    try:
        rig = load_rig(config)
        default = ORDER[1:] if any(s.kind == "mocap" for s in rig.sources) else ("static",)
        status = asyncio.run(_lead(rig, phase or default, seconds, force=force, ask=not yes))
    except ConfigError as fault:
        typer.echo(str(fault), err=True)
        raise typer.Exit(MISUSE) from None
    except NobodyThere:
        typer.echo("jointfit calibrate: nobody can press Enter here: use --yes", err=True)
        raise typer.Exit(MISUSE) from None
    except (BrokerLost, NoAnswer, PhaseAborted, RequestRefused) as fault:
        typer.echo(f"jointfit calibrate: {fault}", err=True)
        raise typer.Exit(1) from None
    _tell(status, json=json)


def _tell(status: Mapping[str, Any], *, json: bool) -> None:
    """Print the last status; end with `NOT_TAKEN` if its result was not."""
    import orjson

    from jointfit_daemon.tools.calibration_report import report

    if json:
        typer.echo(orjson.dumps(status))
    else:
        for line in (str(status.get("text", "done")), *report(status.get("quality") or {})):
            typer.echo(line)
    if status.get("kept") is not None:
        typer.echo(f"jointfit calibrate: not taken: {status['kept']}", err=True)
        raise typer.Exit(NOT_TAKEN)


async def _lead(
    rig: Rig, phases: Sequence[str], seconds: float | None, *, force: bool, ask: bool
) -> dict[str, Any]:
    from rich.console import Console

    from jointfit_daemon.outputs.mqtt_client import MqttClient

    console = Console(stderr=True)
    status: dict[str, Any] = {}
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
                status = await _phase(client, watch, arguments)
    return status


async def _phase(
    client: MqttClient, watch: CalibrationWatch, arguments: dict[str, object]
) -> dict[str, Any]:
    from jointfit_daemon.tools.calibration_guide import RequestRefused

    name = str(arguments["phase"])
    watch.begin()
    answer = await client.request("calibrate", arguments)
    if answer.get("status") == "error":
        raise RequestRefused(str((answer.get("error") or {}).get("message")))
    if name in AT_ONCE:
        return {"text": AT_ONCE[name] + str(answer.get("data", {}).get("phase"))}
    try:
        ended = await watch.ended(name)
    except asyncio.CancelledError:  # Ctrl-C: a phase that nobody leads must not run on
        with suppress(Exception):
            await client.request("calibrate", {"phase": "abort"}, timeout_s=1.0)
        raise
    final = name == "align" or ended.get("kept") is not None
    return dict(ended if final else await watch.stored(ended))


@asynccontextmanager
async def _watching(client: MqttClient, console: Console) -> AsyncIterator[CalibrationWatch]:
    """Show what the daemon says, as a bar on a terminal, else as lines, while the block lasts."""
    from rich.console import Group
    from rich.live import Live
    from rich.progress import Progress
    from rich.text import Text

    from jointfit_daemon.tools.calibration_guide import CalibrationWatch
    from jointfit_daemon.tools.calibration_report import movement_lines

    bar, joints = Progress(console=console), Text()
    task = bar.add_task("", total=1.0)
    screen = Live(Group(bar, joints), console=console, transient=True, auto_refresh=False)
    with screen if console.is_terminal else nullcontext():

        def show(name: str, done: float, text: str) -> None:
            bar.update(task, completed=done, description=name)
            joints.plain = text

        def figures(data: Mapping[str, Any]) -> None:
            joints.plain = "\n".join((joints.plain, *movement_lines(data)))
            screen.refresh()

        watch = CalibrationWatch(show, figures)
        listening = asyncio.create_task(_listen(client, watch, console), name="calibrate listener")
        try:
            yield watch
        finally:
            listening.cancel()
            await asyncio.wait([listening])


async def _listen(client: MqttClient, watch: CalibrationWatch, console: Console) -> None:
    from jointfit_daemon.outputs.mqtt import BrokerLost

    try:
        async for topic, payload in client.messages():
            if isinstance(payload, dict) and (line := _heard(watch, topic, payload)):
                console.print(line, markup=False, highlight=False, soft_wrap=True)
    except BrokerLost as lost:
        watch.lose(lost)


def _heard(watch: CalibrationWatch, topic: str, payload: dict[str, Any]) -> str | None:
    """Tell `watch` what came; return what a person must read at once."""
    from jointfit_daemon.tools.calibration_guide import PhaseAborted

    text = str(payload.get("text", ""))
    if topic == "calibration":
        watch.on_status(payload)
        return None if sys.stderr.isatty() else f"{payload.get('phase')}: {text}"
    if topic == "calibration/progress":
        watch.on_progress(payload)
    elif topic == "bridge/state" and payload.get("state") != "online":
        watch.lose(PhaseAborted("the daemon is not running, or lost its broker"))
    elif topic == "bridge/event" and _matters(payload):
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
