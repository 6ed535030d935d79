"""Command `jointfit demo`: runs the daemon on simulated hardware and checks its joint angles."""

from __future__ import annotations

import asyncio
import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import orjson
import typer

from jointfit_daemon.tools.command_group import EXIT_FAILED
from jointfit_daemon.tools.dashboard.addresses import LISTEN, parse_listen
from jointfit_daemon.tools.output_files import check_output
from jointfit_daemon.tools.stop_signals import StopRequest, cancel_on_signal

if TYPE_CHECKING:
    from collections.abc import Mapping


FLEXION_RMSE_DEG = {"knee": 3.0, "right_knee": 3.0, "elbow": 3.0, "lumbar": 3.0}
"""Largest accepted flexion error (RMS) of the compared joint, degrees."""
TARGETS = {"unaccounted": 0, "latency_p99_ms": 60.0}
"""Largest accepted values of the other results. The page docs/simulator.md lists the simulated
imperfections."""
_LIMBS = "Simulated limb: leg, legs (with pelvis), arm (thorax to hand) or trunk."
_ERROR_KEY = "_flexion_rmse_deg"
"""Suffix of the result key that contains the flexion error; the name of the joint precedes it."""
BASE = "jointfit/demo"
"""Topic prefix of the demo."""


def demo(
    *,
    seconds: Annotated[float, typer.Option(help="Run time after the calibration, s.")] = 30.0,
    headless: Annotated[
        bool, typer.Option("--headless", help="Show no display; print the result as one JSON line.")
    ] = False,
    limb: Annotated[Literal["leg", "legs", "arm", "trunk"], typer.Option(help=_LIMBS)] = "leg",
    seed: Annotated[int, typer.Option(help="Random seed: selects the simulated subject.")] = 1,
    knob: Annotated[
        list[str] | None, typer.Option("--set", help="Simulator setting, NAME=VALUE; repeatable.")
    ] = None,
    keep: Annotated[
        Path | None,
        typer.Option(help="Keep rig, logs, calibration and ground truth in this folder."),
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Save the final display as SVG.")] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Show the run in a web page, until Ctrl-C.")
    ] = False,
    listen: Annotated[
        str, typer.Option(help="Address of the page with --web. Other devices need 0.0.0.0:8080.")
    ] = LISTEN,
) -> None:
    """Run the daemon on simulated hardware; needs no device, broker or root access.

    The command starts a broker, a motion-capture server, the daemon and four IMUs: two on
    pseudo-terminals and two on a CAN adapter (arm: three and three; legs: five and five). Then it
    calibrates, and compares the joint angles with ground truth. It exits with 1 if a step fails or
    a target is missed. The targets are: flexion error of the knee (elbow, lumbar joint) at most 3
    degrees RMS, all samples accounted for, and 99 % of the frames received within 60 ms. Ctrl-C,
    SIGTERM and SIGHUP stop the run and print the results so far. With --web, the limb is calibrated
    and then moves until you stop the run. Nothing is compared then, and the exit code is 0.
    """
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise ValueError(f"--seconds {seconds:g}: expected a finite number above 0")
    check_output("--picture", picture, (".svg",))
    with tempfile.TemporaryDirectory(prefix="jointfit-demo-") as temporary:
        folder = keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        options = [
            "--limb",
            limb,
            "--seed",
            str(seed),
            *(w for k in knob or [] for w in ("--set", k)),
        ]
        if web:
            from jointfit_daemon.tools.demo._web import run_web_demo

            asyncio.run(run_web_demo(folder.resolve(), BASE, options, parse_listen(listen)))
            return
        run = _run(folder.resolve(), seconds, limb, options, headless=headless, picture=picture)
        figures, stopped = asyncio.run(run)
    _report(figures, stopped, headless=headless)


def _report(figures: dict[str, Any], stopped: StopRequest | None, *, headless: bool) -> None:
    """Print the result; exit with an error if a target was missed or the run was stopped."""
    missed = missed_targets(figures)
    if stopped is not None:
        outcome = f"interrupted by {stopped.name}"
    else:
        outcome = "missed a target" if missed else "passed"
        figures["missed"] = missed
    typer.echo(result_line(outcome, figures), err=headless)
    if stopped is not None:
        raise typer.Exit(stopped.exit_code)
    for text in missed:
        typer.echo(f"missed: {text}", err=True)
    if headless:
        typer.echo(orjson.dumps(figures))
    if missed:
        raise typer.Exit(EXIT_FAILED)


def result_line(outcome: str, figures: Mapping[str, Any]) -> str:
    """Return outcome, errors, latency and sample counts in one line."""
    latency, samples = figures.get("latency_ms", {}), figures.get("samples", {})
    joint = _compared_joint(figures)

    def known(key: str, unit: str = "", values: Mapping[str, Any] = figures) -> str:
        return "unknown" if values.get(key) is None else f"{values[key]}{unit}"

    return (
        f"result: {outcome}; {joint} flexion error {known(f'{joint}{_ERROR_KEY}', '°')} RMS"
        f" over {figures.get('frames', 0)} frames; joint center error"
        f" {known('joint_center_error_mm', ' mm')}; latency {known('p50', ' ms', latency)} median,"
        f" {known('p99', ' ms', latency)} p99; samples: {known('sent')} sent,"
        f" {samples.get('received', 0)} received, {known('unaccounted')} unaccounted for,"
        f" {figures.get('corrupt', 0)} corrupt"
    )


def _compared_joint(figures: Mapping[str, Any]) -> str:
    """Return the joint whose flexion error the result contains; the default is the knee."""
    return next((name for name in FLEXION_RMSE_DEG if f"{name}{_ERROR_KEY}" in figures), "knee")


_BUSY = ": other programs probably occupied this computer; close them and repeat the demo"
HINTS = {"latency_p99_ms": ": check the load of this machine"}


def missed_targets(figures: dict[str, Any]) -> list[str]:
    """Return one line for each missed target."""
    values = {**figures, "latency_p99_ms": figures.get("latency_ms", {}).get("p99")}
    joint = _compared_joint(figures)
    targets = {f"{joint}{_ERROR_KEY}": FLEXION_RMSE_DEG[joint]} | TARGETS
    sources = figures.get("unaccounted_by_source") or {}
    places = f" ({', '.join(f'{name} {count}' for name, count in sources.items())})"
    hints = HINTS | ({"unaccounted": f"{places}{_BUSY}"} if sources else {})
    return [
        f"{name} is {found}, expected at most {target:g}{hints.get(name, '')}"
        for name, target in targets.items()
        if (found := values.get(name)) is None or not found <= target
    ]


async def _run(
    folder: Path,
    seconds: float,
    name: str,
    options: list[str],
    *,
    headless: bool,
    picture: Path | None,
) -> tuple[dict[str, Any], StopRequest | None]:
    """Run the demo; return the result, and the stop signal if one was received."""
    from jointfit_daemon.config import load_rig
    from jointfit_daemon.tools.child_processes import daemon, simulator
    from jointfit_daemon.tools.demo._display import DemoDisplay
    from jointfit_daemon.tools.demo._run import LIMBS, DemoRun
    from jointfit_daemon.tools.demo._truth import TruthReader
    from jointfit_daemon.tools.embedded_broker import embedded_broker

    truth = TruthReader(folder / "truth.jsonl")
    run: DemoRun | None = None
    with cancel_on_signal() as stop:
        try:
            with embedded_broker(folder) as port, DemoDisplay(headless=headless) as display:
                display.step("connect", 0.0, "")
                async with simulator(folder, port, BASE, options) as simulated:
                    rig_file = Path((await simulated.ready())["rig"])
                    rig = load_rig(rig_file)
                    async with daemon(folder, rig_file) as process:
                        run = DemoRun(folder, rig, simulated, process, truth, display, LIMBS[name])
                        await run.run(seconds)
                if picture is not None:
                    display.save(picture)
        except (asyncio.CancelledError, Exception) as error:  # Ctrl-C also stops broker and daemon
            if stop.number is None:
                figures = {} if run is None else run.figures()
                typer.echo(result_line("failed", figures), err=headless)
                if headless:
                    typer.echo(orjson.dumps(figures | {"missed": [str(error)]}))
                raise
        finally:
            truth.close()
    stopped = stop if stop.number is not None else None
    return {} if run is None else run.figures(), stopped
