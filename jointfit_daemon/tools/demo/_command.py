"""`jointfit demo`: the main job on virtual hardware, judged against bones that only it knows."""

from __future__ import annotations

import asyncio
import math
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from jointfit_daemon.tools.command_group import EXIT_FAILED

if TYPE_CHECKING:
    from collections.abc import Mapping

    from jointfit_daemon.tools.stop_signals import StopRequest

BOUNDS = {"knee_flexion_rmse_deg": 3.0, "unaccounted": 0, "latency_p99_ms": 60.0}
"""What the demo promises; docs/simulator.md says with which imperfections."""
BASE = "jointfit/demo"
NOTHING_MEASURED: dict[str, Any] = {
    "knee_flexion_rmse_deg": None,
    "frames": 0,
    "joint_center_error_mm": None,
    "latency_ms": {"p50": None, "p99": None},
    "samples": {"received": 0},
    "sent": None,
    "unaccounted": None,
    "corrupt": 0,
}
"""Figures of a run that was interrupted before the daemon was there."""


def demo(
    *,
    seconds: Annotated[float, typer.Option(help="Live time after the calibration, s.")] = 30.0,
    headless: Annotated[
        bool, typer.Option("--headless", help="No display; one JSON object as the last line.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Another seed is another wearer.")] = 1,
    knob: Annotated[
        list[str] | None, typer.Option("--set", help="A knob of the simulator, NAME=VALUE.")
    ] = None,
    keep: Annotated[
        Path | None, typer.Option(help="Keep rig, logs, calibration and truth in this folder.")
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(help="Save the last state of the display as SVG.")
    ] = None,
) -> None:
    """Show the main job on simulated hardware: no device, no broker, no root needed.

    Starts an embedded broker, two IMUs on ptys, two on a CAN adapter, a motion-capture server and
    the real daemon; calibrates; then shows joint angles beside the true ones. Exits with 1 when a
    bound is missed: knee flexion within 3 degrees RMS, every sample accounted for, 99 % of frames
    received within 60 ms. Ctrl-C, SIGTERM and SIGHUP end it early, with the figures so far.
    """
    import orjson

    from jointfit_daemon.tools.output_files import check_output

    if not (math.isfinite(seconds) and seconds > 0.0):
        raise ValueError(f"--seconds {seconds:g}: expected a finite number above 0")
    check_output("--picture", picture, (".svg",))
    with tempfile.TemporaryDirectory(prefix="jointfit-demo-") as temporary:
        folder = keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        options = ["--seed", str(seed), *(w for k in knob or [] for w in ("--set", k))]
        run = _run(folder.resolve(), seconds, options, headless=headless, picture=picture)
        figures, stopped = asyncio.run(run)

    missed = missed_bounds(figures)
    if stopped is not None:
        outcome = f"interrupted by {stopped.name}"
    else:
        outcome = "missed a bound" if missed else "passed"
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
    """Return the outcome, the errors, the latency and the samples in one line."""
    latency, samples = figures["latency_ms"], figures["samples"]

    def known(value: object, unit: str) -> str:
        return "unknown" if value is None else f"{value}{unit}"

    return (
        f"result: {outcome}; knee flexion {known(figures['knee_flexion_rmse_deg'], '°')} RMS off"
        f" over {figures['frames']} frames; joint centers"
        f" {known(figures['joint_center_error_mm'], ' mm')} off; latency"
        f" {known(latency['p50'], ' ms')} median, {known(latency['p99'], ' ms')} p99; samples:"
        f" {known(figures['sent'], '')} sent, {samples['received']} received,"
        f" {known(figures['unaccounted'], '')} unaccounted for, {figures['corrupt']} corrupt"
    )


HINTS = {"latency_p99_ms": ": did other programs keep this machine busy?"}


def missed_bounds(figures: dict[str, Any]) -> list[str]:
    """Return the promises that these figures break, in words."""
    values = {**figures, "latency_p99_ms": figures["latency_ms"]["p99"]}
    return [
        f"{name} is {values[name]}, promised at most {bound:g}{HINTS.get(name, '')}"
        for name, bound in BOUNDS.items()
        if values.get(name) is None or not values[name] <= bound
    ]


async def _run(
    folder: Path, seconds: float, options: list[str], *, headless: bool, picture: Path | None
) -> tuple[dict[str, Any], StopRequest | None]:
    """Return the figures, and the signal that ended the run early, if one did."""
    from jointfit_daemon.config import load_rig
    from jointfit_daemon.tools.child_processes import daemon, simulator
    from jointfit_daemon.tools.demo._display import Display
    from jointfit_daemon.tools.demo._run import Demo
    from jointfit_daemon.tools.demo._truth import TruthReader
    from jointfit_daemon.tools.embedded_broker import embedded_broker
    from jointfit_daemon.tools.stop_signals import cancel_on_signal

    truth = TruthReader(folder / "truth.jsonl")
    run: Demo | None = None
    with cancel_on_signal() as stop:
        try:
            with embedded_broker(folder) as port, Display(headless=headless) as display:
                display.step("connect", 0.0, "")
                async with simulator(folder, port, BASE, options) as limb:
                    rig_file = Path((await limb.ready())["rig"])
                    rig = load_rig(rig_file)
                    async with daemon(folder, rig_file) as process:
                        run = Demo(folder, rig, limb, process, truth, display)
                        await run.run(seconds)
                if picture is not None:
                    display.save(picture)
        except (asyncio.CancelledError, Exception):  # Ctrl-C ends broker and daemon as well
            if stop.number is None:
                raise
        finally:
            truth.close()
    stopped = stop if stop.number is not None else None
    return NOTHING_MEASURED if run is None else run.figures(), stopped
