"""Command `jointfit demo`: runs the daemon on simulated hardware and checks its joint angles."""

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

TARGETS = {"knee_flexion_rmse_deg": 3.0, "unaccounted": 0, "latency_p99_ms": 60.0}
"""Largest accepted values; docs/simulator.md lists the simulated imperfections."""
BASE = "jointfit/demo"
"""Topic prefix of the demo."""
NO_RESULT: dict[str, Any] = {
    "knee_flexion_rmse_deg": None,
    "frames": 0,
    "joint_center_error_mm": None,
    "latency_ms": {"p50": None, "p99": None},
    "samples": {"received": 0},
    "sent": None,
    "unaccounted": None,
    "corrupt": 0,
}
"""Result of a run that was interrupted before the daemon started."""


def demo(
    *,
    seconds: Annotated[float, typer.Option(help="Live time after the calibration, s.")] = 30.0,
    headless: Annotated[
        bool, typer.Option("--headless", help="No display; print the result as one JSON line.")
    ] = False,
    seed: Annotated[int, typer.Option(help="Random seed: selects the simulated subject.")] = 1,
    knob: Annotated[
        list[str] | None, typer.Option("--set", help="Simulator setting, NAME=VALUE; repeatable.")
    ] = None,
    keep: Annotated[
        Path | None, typer.Option(help="Folder for rig, logs, calibration and ground truth.")
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="Save the final display as SVG.")] = None,
) -> None:
    """Run the daemon on simulated hardware; needs no device, broker or root access.

    Starts a broker, two IMUs on pseudo-terminals, two on a CAN adapter, a motion-capture server and
    the daemon, calibrates, and compares the joint angles with ground truth. Exits with 1 if a
    target is missed: knee flexion error 3 degrees RMS, all samples accounted for, 99 % of frames
    received within 60 ms. Ctrl-C, SIGTERM and SIGHUP stop the run and print the results so far.
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
    latency, samples = figures["latency_ms"], figures["samples"]

    def known(value: object, unit: str) -> str:
        return "unknown" if value is None else f"{value}{unit}"

    return (
        f"result: {outcome}; knee flexion error"
        f" {known(figures['knee_flexion_rmse_deg'], '°')} RMS over {figures['frames']} frames;"
        f" joint center error {known(figures['joint_center_error_mm'], ' mm')}; latency"
        f" {known(latency['p50'], ' ms')} median, {known(latency['p99'], ' ms')} p99; samples:"
        f" {known(figures['sent'], '')} sent, {samples['received']} received,"
        f" {known(figures['unaccounted'], '')} unaccounted for, {figures['corrupt']} corrupt"
    )


HINTS = {"latency_p99_ms": ": check the load of this machine"}


def missed_targets(figures: dict[str, Any]) -> list[str]:
    """Return one line for each target that the result misses."""
    values = {**figures, "latency_p99_ms": figures["latency_ms"]["p99"]}
    return [
        f"{name} is {values[name]}, expected at most {target:g}{HINTS.get(name, '')}"
        for name, target in TARGETS.items()
        if values.get(name) is None or not values[name] <= target
    ]


async def _run(
    folder: Path, seconds: float, options: list[str], *, headless: bool, picture: Path | None
) -> tuple[dict[str, Any], StopRequest | None]:
    """Return the result, and the stop signal if one was received."""
    from jointfit_daemon.config import load_rig
    from jointfit_daemon.tools.child_processes import daemon, simulator
    from jointfit_daemon.tools.demo._display import DemoDisplay
    from jointfit_daemon.tools.demo._run import DemoRun
    from jointfit_daemon.tools.demo._truth import TruthReader
    from jointfit_daemon.tools.embedded_broker import embedded_broker
    from jointfit_daemon.tools.stop_signals import cancel_on_signal

    truth = TruthReader(folder / "truth.jsonl")
    run: DemoRun | None = None
    with cancel_on_signal() as stop:
        try:
            with embedded_broker(folder) as port, DemoDisplay(headless=headless) as display:
                display.step("connect", 0.0, "")
                async with simulator(folder, port, BASE, options) as limb:
                    rig_file = Path((await limb.ready())["rig"])
                    rig = load_rig(rig_file)
                    async with daemon(folder, rig_file) as process:
                        run = DemoRun(folder, rig, limb, process, truth, display)
                        await run.run(seconds)
                if picture is not None:
                    display.save(picture)
        except (asyncio.CancelledError, Exception):  # Ctrl-C also stops broker and daemon
            if stop.number is None:
                raise
        finally:
            truth.close()
    stopped = stop if stop.number is not None else None
    return NO_RESULT if run is None else run.figures(), stopped
