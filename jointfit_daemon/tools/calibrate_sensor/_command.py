"""Command `jointfit calibrate sensor`: guides the user through movements and writes the result.

Invariant: rig.toml is either replaced as a whole after the last step, or unchanged.
"""

from __future__ import annotations

import asyncio
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from jointfit_daemon.tools.command_group import EXIT_FAILED
from jointfit_daemon.tools.completion import complete_sensor

if TYPE_CHECKING:
    from collections.abc import Iterator

    from jointfit_daemon.config import Rig, Source
    from jointfit_daemon.model import Chunk
    from jointfit_daemon.sensor_calibration import SensorCalibrationSettings
    from jointfit_daemon.tools.calibrate_sensor._guided_steps import SensorFindings


def _complete_steps(incomplete: str) -> list[str]:
    """Return the possible completions of a partly typed list of steps."""
    from jointfit_daemon.tools.calibrate_sensor._guided_steps import STEPS

    given = incomplete.split(",")[:-1]
    lists = [",".join((*given, step)) for step in STEPS if step not in given]
    return [steps for steps in lists if steps.startswith(incomplete)]


_Steps = Annotated[
    str | None,
    typer.Option(
        help="gyroscope, accelerometer, magnetometer, separated by commas. Default: the first two, "
        "and the magnetometer if rig.toml uses it.",
        autocompletion=_complete_steps,
    ),
]
_StepTime = Annotated[
    float, typer.Option("--step", help="Longest time for a step, s.", min=10.0, max=3600.0)
]
_Recording = Annotated[
    Path | None,
    typer.Option(help="Take the movements from this recording instead of the live sensor."),
]
_PrintOnly = Annotated[
    bool, typer.Option("--print", help="Print the lines for rig.toml instead of writing them.")
]


def calibrate_sensor(
    name: Annotated[
        str,
        typer.Argument(metavar="ID", help="Sensor id in rig.toml.", autocompletion=complete_sensor),
    ],
    *,
    rig: Annotated[
        Path, typer.Option("--rig", "--config", help="Configuration of the sensor.")
    ] = Path("rig.toml"),
    steps: _Steps = None,
    step_s: _StepTime = 180.0,
    recording: _Recording = None,
    print_only: _PrintOnly = False,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Calibrate the raw readings of one sensor by guided movements; the daemon must be stopped.

    The command estimates the bias of the gyroscope at rest; bias, scale and axes of the
    accelerometer from static poses; scale and axes of the gyroscope from the turns between these
    poses; and hard and soft iron of the magnetometer from free rotation. Each step ends by itself.
    The result is written into the table imu.sensor_calibration of rig.toml, which the daemon uses
    from its next start or reload. Exit codes: 0 all steps have a result; 1 the sensor is lost, or a
    step was refused (the results of the other steps are written); 2 invalid options or rig.toml;
    128 + N stopped by signal N, nothing was written.
    """
    from jointfit_daemon.config import load_rig
    from jointfit_daemon.tools.text_output import echo_json, echo_wrapped

    named = _named_steps(steps)
    own = load_rig(rig)
    configured = _sensor(own, name)
    if recording is None:
        source = _calibratable(own, name, configured)
        findings = _run_live(source, _possible_steps(named, source), step_s, json=json)
    else:
        from jointfit_daemon.reprocessing import recorded_rig

        source = _calibratable(recorded_rig(recording), name, configured)
        findings = _take_recording(source, _possible_steps(named, source), recording)

    lines: list[str] = []
    written = False
    if findings.estimates:
        from jointfit_daemon.sensor_calibration import calibration_of
        from jointfit_daemon.tools.calibrate_sensor._calibration_table import make_calibration

        today = datetime.now(UTC).astimezone().date().isoformat()
        before = calibration_of(configured.settings)
        calibration = make_calibration(findings.estimates, today, findings.serial, before)
        lines, written = _write(rig, name, calibration, print_only=print_only)

    from jointfit_daemon.tools.calibrate_sensor._sensor_report import report_data, report_lines

    if json:
        echo_json(
            report_data(name, findings)
            | {"written": str(rig) if written else None, "rig_toml": lines}
        )
    else:
        for line in report_lines(name, findings):
            echo_wrapped(line)
        for line in _closing_lines(rig, name, lines, written=written):
            typer.echo(line)
    if findings.refused:
        raise typer.Exit(EXIT_FAILED)


def _sensor(rig: Rig, name: str) -> Source:
    from jointfit_daemon.nearest_name import unknown_name

    sensors = {source.id: source for source in rig.sources if source.kind == "imu"}
    if name not in sensors:
        raise ValueError(unknown_name("sensor", name, list(sensors)))
    return sensors[name]


def _calibratable(rig: Rig, name: str, configured: Source) -> Source:
    """Return the sensor; raise ValueError unless the gateway computes its orientation."""
    from jointfit_daemon.sensor_calibration import CalibratableSettings

    for source in (configured, _sensor(rig, name)):
        if not isinstance(source.settings, CalibratableSettings):
            raise ValueError(  # noqa: TRY004 - a wrong option
                f"{name}: driver {source.driver!r} receives orientations and no raw readings: the "
                "device corrects its sensors itself. Calibrate it with the vendor's program"
            )
        if source.settings.orientation != "gateway":
            raise ValueError(
                f"{name}: its orientation comes from the device, and raw readings are not used: "
                'set orientation = "gateway" in its [[imu]] table first'
            )
    return _sensor(rig, name)


def _named_steps(steps: str | None) -> list[str] | None:
    """Return the steps in the option ``--steps``, or None; raise ValueError for an unknown step."""
    from jointfit_daemon.tools.calibrate_sensor._guided_steps import STEPS
    from jointfit_daemon.tools.text_output import join_choices

    if steps is None:
        return None
    named = [step.strip() for step in steps.split(",")]
    if wrong := [step for step in named if step not in STEPS]:
        raise ValueError(
            f"--steps {', '.join(map(repr, wrong))}: expected {join_choices(list(STEPS))}"
        )
    return [step for step in STEPS if step in named]


def _possible_steps(named: list[str] | None, source: Source) -> list[str]:
    """Return the given steps, or all steps that the sensor supports if none are given."""
    from jointfit_daemon.tools.calibrate_sensor._guided_steps import STEPS

    magnetic = bool(source.settings.magnetometer)
    if named is None:
        return [step for step in STEPS if magnetic or step != "magnetometer"]
    if "magnetometer" in named and not magnetic:
        raise ValueError(
            f"--steps magnetometer: {source.id} does not use its magnetometer: set magnetometer = "
            "true in its [[imu]] table first"
        )
    return named


def _run_live(source: Source, names: list[str], step_s: float, *, json: bool) -> SensorFindings:
    from jointfit_daemon.calibration.inertial_sensor import SensorCalibrationError
    from jointfit_daemon.tools.calibrate_sensor._guided_steps import run_steps
    from jointfit_daemon.tools.calibrate_sensor._step_display import StepDisplay
    from jointfit_daemon.tools.stop_signals import cancel_on_signal

    async def run() -> SensorFindings:
        with cancel_on_signal() as stop, StepDisplay(err=json) as display:
            try:
                return await run_steps(source, names, display, step_s=step_s)
            except asyncio.CancelledError:
                typer.echo(f"stopped by {stop.name}: nothing was written", err=True)
                raise typer.Exit(stop.exit_code) from None

    try:
        return asyncio.run(run())
    except SensorCalibrationError as error:
        typer.echo(f"jointfit calibrate sensor: {error}", err=True)
        raise typer.Exit(EXIT_FAILED) from None


def _take_recording(source: Source, names: list[str], recording: Path) -> SensorFindings:
    from jointfit_daemon.outputs.recording import read_events
    from jointfit_daemon.pipeline.events import ChunkArrived
    from jointfit_daemon.tools.calibrate_sensor._guided_steps import take_recorded

    def chunks() -> Iterator[Chunk]:
        for event in read_events(recording):
            if isinstance(event, ChunkArrived) and event.source == source.id:
                yield event.chunk

    return take_recorded(source, names, chunks())


def _write(
    rig: Path, name: str, calibration: SensorCalibrationSettings, *, print_only: bool
) -> tuple[list[str], bool]:
    """Write the calibration table into rig.toml if possible.

    Return the lines of the table, and whether they were written.
    """
    from jointfit_daemon.tools.calibrate_sensor._calibration_table import insert_table, table_lines
    from jointfit_daemon.tools.output_files import replace_file

    lines = table_lines(calibration)
    path = rig.resolve()
    if print_only or not (os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)):
        return lines, False
    text = insert_table(path.read_bytes().decode(), name, calibration)
    if text is None:
        return lines, False

    mode = path.stat().st_mode
    replace_file(path, text)
    path.chmod(mode)
    return lines, True


def _closing_lines(rig: Path, name: str, lines: list[str], *, written: bool) -> list[str]:
    if not lines:
        return [f"{rig} is unchanged"]
    if written:
        return [f"written to {rig}; the daemon uses it from its next start or reload"]
    return [f"not written: add these lines to {rig}, below the [[imu]] table of {name}:", *lines]
