"""`jointfit calibrate`: leads through a calibration of a running daemon, over MQTT."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig

MISUSE = 2
ORDER = ("align", "static", "functional")
SAYS = {
    "align": "Fix all sensors on the plate and turn it by hand about all axes.",
    "static": "Put everything on. Stand still and upright.",
    "functional": "Move every joint: walk, squat, sit down and stand up, circle the hip.",
}


def calibrate(
    config: Annotated[Path, typer.Argument(help="The rig.toml of the daemon.")] = Path("rig.toml"),
    *,
    phase: Annotated[
        list[str] | None,
        typer.Option(help="align, static, functional or abort; default: static, functional."),
    ] = None,
    seconds: Annotated[float | None, typer.Option(help="Length of each phase, s.")] = None,
    force: Annotated[
        bool, typer.Option("--force", help="Replace the stored calibration even by a worse one.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before each phase.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the last status as JSON.")] = False,
) -> None:
    """Lead through a calibration: says what to do, shows progress, tells the figures."""
    import orjson

    from jointfit_daemon.config import ConfigError, load_rig
    from jointfit_daemon.outputs.mqtt import BrokerLost
    from jointfit_daemon.outputs.mqtt_client import NoAnswer
    from jointfit_daemon.tools.calibration_guide import PhaseAborted, RequestRefused

    phases = phase or ["static", "functional"]
    wrong = [name for name in phases if name not in (*ORDER, "abort")]
    if wrong:
        typer.echo(f"--phase {wrong[0]}: expected one of {', '.join(ORDER)}, abort", err=True)
        raise typer.Exit(MISUSE)
    try:
        rig = load_rig(config)
        status = asyncio.run(_lead(rig, phases, seconds, force=force, ask=not yes))
    except ConfigError as fault:
        typer.echo(str(fault), err=True)
        raise typer.Exit(MISUSE) from None
    except (BrokerLost, NoAnswer, PhaseAborted, RequestRefused) as fault:
        typer.echo(f"jointfit calibrate: {fault}", err=True)
        raise typer.Exit(1) from None
    if json:
        typer.echo(orjson.dumps(status))
    else:
        typer.echo(str(status.get("text", "done")))


async def _lead(
    rig: Rig, phases: list[str], seconds: float | None, *, force: bool, ask: bool
) -> dict[str, Any]:
    from rich.progress import Progress

    from jointfit_daemon.outputs.mqtt_client import MqttClient
    from jointfit_daemon.tools.calibration_guide import CalibrationWatch

    async with MqttClient(rig.mqtt) as client:
        await client.subscribe("calibration", "calibration/progress", "bridge/event")
        with Progress(transient=True) as bar:
            task = bar.add_task("", total=1.0)

            def show(name: str, done: float, text: str) -> None:
                bar.update(task, completed=done, description=f"{name}: {text}")

            watch = CalibrationWatch(show)
            listening = asyncio.create_task(_listen(client, watch), name="calibrate listener")
            try:
                for name in phases:
                    if ask and name in SAYS:
                        bar.stop()
                        await asyncio.to_thread(input, f"{SAYS[name]} Enter to begin: ")
                        bar.start()
                    await _phase(client, watch, name, seconds, force=force)
            finally:
                listening.cancel()
                await asyncio.wait([listening])
        return dict(watch.status)


async def _phase(client: Any, watch: Any, name: str, seconds: float | None, *, force: bool) -> None:
    from jointfit_daemon.tools.calibration_guide import RequestRefused

    arguments: dict[str, object] = {"phase": name, "force": force}
    if seconds is not None:
        arguments["seconds"] = seconds
    watch.begin()
    answer = await client.request("calibrate", arguments)
    if answer.get("status") == "error":
        raise RequestRefused(str((answer.get("error") or {}).get("message")))
    if name != "abort":
        await watch.ended(name)


async def _listen(client: Any, watch: Any) -> None:
    async for topic, payload in client.messages():
        if not isinstance(payload, dict):
            continue
        if topic == "calibration":
            watch.on_status(payload)
        elif topic == "calibration/progress":
            watch.on_progress(payload)
