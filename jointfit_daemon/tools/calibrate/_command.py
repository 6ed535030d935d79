"""Command `jointfit calibrate`: requests calibration phases over MQTT and reports their results.

Invariants: only the result is written to stdout; prompts, progress and warnings are written to
stderr. If the command is stopped during a phase that it started, it first aborts this phase,
provided that the broker and the daemon are reachable.
"""

from __future__ import annotations

import asyncio
import sys
from contextlib import asynccontextmanager, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import orjson
import typer

from jointfit_daemon.tools.calibrate._offline import calibrate_offline
from jointfit_daemon.tools.calibrate._phase_tracker import (
    PhaseTracker,
    is_not_stored,
    raise_if_refused,
)
from jointfit_daemon.tools.calibrate._report import ProgressLines, movement_lines, report
from jointfit_daemon.tools.calibrate._versions import list_versions, use_version
from jointfit_daemon.tools.command_group import EXIT_FAILED, is_given
from jointfit_daemon.tools.completion import complete_rig_or_command
from jointfit_daemon.tools.stop_signals import cancel_on_signal

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Mapping, Sequence

    from rich.console import Console

    from jointfit_daemon.config import Rig
    from jointfit_daemon.outputs.mqtt import MqttClient

EXIT_REJECTED = 3
"""Exit code if the new calibration is worse than the stored calibration."""
ABORT_S = 2.0
"""Longest wait for the daemon's answer to an abort request, s."""
LONGEST_S = 600.0
"""Longest phase that a request can specify, s. The JSON Schema of the request has the same limit.
"""
ORDER = ("align", "static", "functional")
IMMEDIATE_REQUESTS = {
    "abort": "the running phase, if any, was aborted; current state: ",
    "revert": "online learning reverted; current state: ",
}
_PHASES = (*ORDER, *IMMEDIATE_REQUESTS)
INSTRUCTIONS = {
    "align": "Fix all sensors to the plate and rotate the plate by hand about all three axes.",
    "static": "Put on all sensors and markers. Stand upright and still.",
    "functional": "Move every joint: walk, squat, sit down and stand up, circle the hip.",
}
TOPICS = ("calibration", "calibration/progress", "bridge/event", "bridge/state")


_List = Annotated[
    bool, typer.Option("--list", help="List the stored calibrations with their quality.")
]
_Use = Annotated[int | None, typer.Option("--use", help="Use this stored version again.", min=1)]
_Recording = Annotated[
    Path | None,
    typer.Option(help="Repeat the calibration of a recorded session, without a daemon."),
]
_OtherRig = Annotated[
    Path | None, typer.Option("--rig", help="With --recording: replaces the recorded rig.toml.")
]
_Out = Annotated[
    Path | None,
    typer.Option(help="With --recording: write to this .json file instead of the store."),
]
_Revert = Annotated[
    bool, typer.Option("--revert", help="Use the version before the active version.")
]


class StandardInputClosedError(ValueError):
    """Standard input is closed, so the prompt before a phase cannot be answered."""

    def __init__(self) -> None:
        super().__init__("standard input is closed, expected a terminal for the prompts: use --yes")


class OutputLostError(Exception):
    """Standard error is closed, for example because the terminal was closed."""


_Config = Annotated[
    Path,
    typer.Argument(help="The rig.toml of the daemon.", autocompletion=complete_rig_or_command),
]
_Phases = Annotated[
    list[str] | None,
    typer.Option(
        help="align, static, functional, abort or revert; repeatable. Default: static, and"
        " functional if rig.toml has a motion-capture source.",
        autocompletion=lambda incomplete: [p for p in _PHASES if p.startswith(incomplete)],
    ),
]
_Seconds = Annotated[
    float | None,
    typer.Option(help="Duration of each phase, s, up to 600. Default: from rig.toml."),
]
_Force = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Accept a calibration that is worse than the stored calibration, and a static pose "
        "whose marker labels do not match the chain model.",
    ),
]


def calibrate(
    context: typer.Context,
    config: _Config = Path("rig.toml"),
    *,
    phase: _Phases = None,
    seconds: _Seconds = None,
    abort: Annotated[bool, typer.Option("--abort", help="Abort the running phase.")] = False,
    listed: _List = False,
    use: _Use = None,
    revert: _Revert = False,
    recording: _Recording = None,
    rig: _OtherRig = None,
    out: _Out = None,
    force: _Force = False,
    yes: Annotated[bool, typer.Option("--yes", help="Start each phase without a prompt.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the final status as JSON.")] = False,
) -> None:
    """Calibrate the rig of a running daemon; Ctrl-C or SIGTERM aborts the phase.

    With --recording, the command repeats the recorded phases and stores their result.

    Exit codes: 0 success; 1 no broker, no daemon, a phase was refused or aborted, or its result
    could not be stored; 2 invalid options or rig.toml; 3 the result is worse than the stored
    calibration, which remains active (--force replaces it); 128 + N stopped by signal N after the
    phase was aborted.
    """
    from jointfit_daemon.config import load_rig

    wrong = [name for name in phase or () if name not in _PHASES]
    if wrong:
        raise ValueError(f"--phase {wrong[0]}: expected one of {', '.join(_PHASES)}")
    if seconds is not None and not 0.0 < seconds <= LONGEST_S:
        raise ValueError(f"--seconds {seconds:g}: expected 0 < seconds <= {LONGEST_S:g}")
    if sum((abort, listed, use is not None, revert, bool(phase), recording is not None)) > 1:
        raise ValueError(
            "expected one of --phase, --abort, --list, --use, --revert and --recording"
        )
    if recording is not None:
        _check_no_config(context, config)
        status = calibrate_offline(recording, rig, out)
        _print_status(status, json=json)
        return
    if rig is not None or out is not None:
        raise ValueError(f"{'--rig' if rig else '--out'}: valid with --recording only")
    if listed:
        list_versions(config, json=json)
        return
    if revert or use is not None:
        use_version(config, use, json=json)
        return

    own = load_rig(config)
    default = ORDER[1:] if any(s.kind == "mocap" for s in own.sources) else ("static",)
    phases = ("abort",) if abort else phase or default
    try:
        status = asyncio.run(_guide_phases(own, phases, seconds, config, force=force, ask=not yes))
    except OutputLostError:
        raise typer.Exit(EXIT_FAILED) from None
    _print_status(status, json=json)


def _check_no_config(context: typer.Context, config: Path) -> None:
    """Raise ValueError if the command line has a rig.toml that ``--recording`` does not use."""
    if is_given(context, "config"):
        raise ValueError(
            f"{config}: --recording uses the recorded rig.toml; write --rig {config} to replace it,"
            " or omit this argument"
        )


def _print_status(status: Mapping[str, Any], *, json: bool) -> None:
    """Print the final status; exit with an error if the result was rejected or not stored."""
    if json:
        typer.echo(orjson.dumps(status))
    else:
        for line in (str(status.get("text", "done")), *report(status.get("quality") or {})):
            typer.echo(line)
    if status.get("kept") is not None:
        typer.echo(f"jointfit calibrate: calibration rejected: {status['kept']}", err=True)
        raise typer.Exit(EXIT_REJECTED)
    if is_not_stored(status):
        typer.echo(f"jointfit calibrate: calibration {status['text']}", err=True)
        raise typer.Exit(EXIT_FAILED)


async def _guide_phases(
    rig: Rig, phases: Sequence[str], seconds: float | None, config: Path, *, force: bool, ask: bool
) -> dict[str, Any]:
    from rich.console import Console

    from jointfit_daemon.outputs.mqtt import MqttClient, missing_password

    console = Console(stderr=True)
    if (missing := missing_password(rig.mqtt)) is not None:
        _print_note(
            f"jointfit calibrate: user {rig.mqtt.username!r} has no password: {missing}. Create "
            "the file, or correct [mqtt]; connecting without a password"
        )
    status: dict[str, Any] = {}
    with cancel_on_signal() as stop:
        try:
            async with MqttClient(rig.mqtt) as client:
                for name in phases:
                    if ask and name in INSTRUCTIONS:
                        console.print(
                            f"{INSTRUCTIONS[name]} Press Enter to begin: ", end="", soft_wrap=True
                        )
                        await _wait_for_enter()
                    arguments: dict[str, object] = {"phase": name, "force": force}
                    if seconds is not None:
                        arguments["seconds"] = seconds
                    async with _track_progress(client, console) as tracker:
                        # Each subscription delivers the retained status. Wait for it, so that it
                        # cannot be mistaken for the result of the phase.
                        await client.subscribe(*TOPICS)
                        await tracker.wait_for_retained()
                        status = await _run_phase(client, tracker, arguments, config)
        except asyncio.CancelledError:
            if stop.number is None:
                raise
            _print_note(f"jointfit calibrate: stopped by {stop.name}")
            raise typer.Exit(stop.exit_code) from None
    return status


async def _run_phase(
    client: MqttClient, tracker: PhaseTracker, arguments: dict[str, object], config: Path
) -> dict[str, Any]:

    name = str(arguments["phase"])
    tracker.begin()
    # The request runs in its own task, so its answer arrives even if a signal cancels this task.
    request = asyncio.create_task(client.request("calibrate", arguments), name="calibrate request")
    try:
        answer = await _await_answer(client, tracker, request, name)
        raise_if_refused(answer)
        if name in IMMEDIATE_REQUESTS:
            return {"text": IMMEDIATE_REQUESTS[name] + str(answer.get("data", {}).get("phase"))}
        ended = await tracker.wait_for_end(name)
    except (asyncio.CancelledError, OutputLostError):
        if name not in IMMEDIATE_REQUESTS:
            await _abort_phase(client, tracker, name, request, config)
        raise
    final = name == "align" or ended.get("kept") is not None
    return dict(ended if final else await tracker.wait_for_store(ended))


async def _await_answer(
    client: MqttClient, tracker: PhaseTracker, request: asyncio.Task[dict[str, Any]], name: str
) -> dict[str, Any]:
    """Return the answer to `request`; without an answer, return {} if the status shows success.

    Raises
    ------
    NoAnswerError
        No answer arrived, and no status shows that the requested phase has begun. If `name` is a
        phase, an abort request was sent, because the daemon may still receive `request`.
    """
    from jointfit_daemon.outputs.mqtt import BrokerLostError, NoAnswerError

    try:
        return await asyncio.shield(request)
    except NoAnswerError:
        if name in IMMEDIATE_REQUESTS:
            raise
        if not tracker.has_begun(name):
            with suppress(NoAnswerError, BrokerLostError):
                await client.request("calibrate", {"phase": "abort"}, timeout_s=ABORT_S)
        if not tracker.has_begun(name):
            raise
    return {}


async def _abort_phase(
    client: MqttClient,
    tracker: PhaseTracker,
    name: str,
    request: asyncio.Task[dict[str, Any]],
    config: Path,
) -> None:
    """Abort the phase that this command started, and report the outcome.

    If the phase ends before the daemon receives the abort, the final status is reported. If the
    daemon refused the request, a running phase belongs to another client and is not aborted. The
    abort request runs in its own task because the current task is already cancelled.
    """
    await asyncio.wait([request], timeout=ABORT_S)
    started = request.done() and not request.cancelled() and request.exception() is None
    if started and request.result().get("status") == "error":
        return

    ending = asyncio.create_task(client.request("calibrate", {"phase": "abort"}), name="abort")
    await asyncio.wait([ending], timeout=ABORT_S)
    if ending.done() and not ending.cancelled() and ending.exception() is None:
        # The status shows whether a phase was running; the answer does not.
        final = asyncio.create_task(tracker.wait_for_final(name), name="final status")
        await asyncio.wait([final], timeout=ABORT_S)
        status: Mapping[str, Any] = {}
        if final.done() and final.exception() is None:
            status = final.result()
        final.cancel()
        if status.get("phase") in (None, "aborted"):
            _print_note(f"{name}: aborted")
        else:
            _print_note(f"{name}: ended before the abort: {status.get('text')}")
    else:
        ending.cancel()
        _print_note(
            f"{name}: the daemon did not answer the abort within {ABORT_S:g} s; the phase may still"
            f" be running. To stop it: jointfit calibrate {config} --abort"
        )


def _print_note(text: str) -> None:
    """Print a line on standard error; ignore a closed stream."""
    with suppress(OSError):
        typer.echo(text, err=True)


@asynccontextmanager
async def _track_progress(client: MqttClient, console: Console) -> AsyncIterator[PhaseTracker]:
    """Track calibration messages, and show their progress.

    The progress is a bar on a terminal, and periodic lines elsewhere.
    """
    from rich.console import Group
    from rich.live import Live
    from rich.progress import Progress
    from rich.text import Text

    from jointfit_daemon.outputs.mqtt import BrokerLostError

    bar, joints, lines = Progress(console=console), Text(), ProgressLines()
    task = bar.add_task("", total=1.0)
    screen = Live(Group(bar, joints), console=console, transient=True, auto_refresh=False)
    with screen if console.is_terminal else nullcontext():

        def show(name: str, done: float, text: str) -> None:
            bar.update(task, completed=done, description=name)
            joints.plain = text
            lines.update(name, done, text)

        def show_details(data: Mapping[str, Any]) -> None:
            if console.is_terminal:
                joints.plain = "\n".join((joints.plain, *movement_lines(data)))
                screen.refresh()
                return
            for line in lines.due(asyncio.get_running_loop().time(), data):
                typer.echo(line, err=True)

        tracker = PhaseTracker(show, show_details)

        async def listen() -> None:
            try:
                async for topic, payload in client.messages():
                    if isinstance(payload, dict) and (
                        line := handle_message(tracker, topic, payload)
                    ):
                        console.print(line, markup=False, highlight=False, soft_wrap=True)
            except BrokerLostError as lost:
                tracker.fail(lost)
            except (OSError, SystemExit) as error:  # rich converts a broken pipe into SystemExit
                tracker.fail(OutputLostError(str(error)))

        listener = asyncio.create_task(listen(), name="calibrate listener")
        try:
            yield tracker
        finally:
            listener.cancel()
            await asyncio.wait([listener])


def handle_message(tracker: PhaseTracker, topic: str, payload: dict[str, Any]) -> str | None:
    """Pass a message to the tracker; return a line to show at once, or None."""
    text = str(payload.get("text", ""))
    if topic == "calibration":
        tracker.on_status(payload)
        # The error message of the command contains the reason of an abort.
        printed = tracker.is_requested and payload.get("phase") != "aborted"
        return f"{payload.get('phase')}: {text}" if printed and not sys.stderr.isatty() else None
    if topic == "calibration/progress":
        tracker.on_progress(payload)
        return None
    if topic == "bridge/state":
        return tracker.on_state(payload.get("state"))

    # Events of the calibration at level "warning" repeat the status line.
    urgent = {
        "device": ("warning", "error"),
        "state": ("warning", "error"),
        "calibration": ("error",),
    }
    if payload.get("level") not in urgent.get(str(payload.get("kind")), ()):
        return None
    if text == tracker.status.get("text") and not sys.stderr.isatty():
        return None  # the status line contains the same text
    return f"{payload.get('id')}: {text}"


async def _wait_for_enter() -> None:
    """Wait for a line on standard input; cancellation ends the wait.

    Raises
    ------
    StandardInputClosedError
        Standard input is closed or cannot be polled.
    """
    loop, pressed = asyncio.get_running_loop(), asyncio.Event()
    try:
        loop.add_reader(sys.stdin, pressed.set)
    except (OSError, ValueError) as error:
        raise StandardInputClosedError from error

    try:
        await pressed.wait()
    finally:
        loop.remove_reader(sys.stdin)

    if not sys.stdin.readline():
        raise StandardInputClosedError
