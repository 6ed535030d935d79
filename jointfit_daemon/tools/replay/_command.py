"""Command `jointfit replay`: processes a recording again, to verify, show or publish it.

Invariant: a replay changes no file.
"""

from __future__ import annotations

import asyncio
import math
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import orjson
import typer

from jointfit_daemon.tools.activity import show_activity
from jointfit_daemon.tools.command_group import EXIT_FAILED

if TYPE_CHECKING:
    from jointfit_daemon.config import Rig
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.reprocessing import Changes

_FASTEST = "max"
_CHOICES = (
    "the recorded configuration at the highest speed, because the outputs are compared byte for"
    " byte: omit {given}, or --verify"
)

_Base = Annotated[
    str | None,
    typer.Option(help="Base topic for --mqtt. Default: replay/ and the base topic of the rig."),
]


def replay(
    file: Annotated[
        Path, typer.Argument(help="A recording, any part of it, or the folder of its parts.")
    ],
    *,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify", help="Compare every output with the recorded output, byte for byte."
        ),
    ] = False,
    speed: Annotated[
        str | None,
        typer.Option(help="Multiple of the recorded speed, or max. Default: max; with --mqtt 1."),
    ] = None,
    mqtt: Annotated[
        bool, typer.Option("--mqtt", help="Publish as the daemon does, below replay/BASE.")
    ] = False,
    base: _Base = None,
    broker: Annotated[
        str | None, typer.Option(help="HOST or HOST:PORT for --mqtt. Default: the rig's broker.")
    ] = None,
    rig: Annotated[
        Path | None, typer.Option(help="Process again with this rig.toml; fits are computed again.")
    ] = None,
    calibration: Annotated[
        str | None,
        typer.Option(
            help="Process again with this calibration in force: a stored version or a file."
        ),
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print the result as JSON.")] = False,
) -> None:
    """Process a recording again as the daemon does: print its time line, verify or publish it.

    With the recorded configuration, the outputs equal the recorded outputs, byte for byte. With
    another rig or calibration, they equal the outputs of a daemon with this rig or calibration.

    Exit codes: 0 success; 1 --verify found a difference or nothing to compare, or no broker; 2
    invalid options, recording, rig or calibration; 128 + N stopped by signal N.
    """
    factor = _speed(speed, 1.0 if mqtt else math.inf)
    if verify:
        given = {"--rig": rig, "--calibration": calibration, "--mqtt": mqtt, "--speed": speed}
        wrong = [name for name, value in given.items() if value]
        if wrong:
            raise ValueError("--verify: expected " + _CHOICES.format(given=" and ".join(wrong)))
        _verify(file, json=json)
        return
    if (base or broker) and not mqtt:
        raise ValueError(f"{'--base' if base else '--broker'}: valid with --mqtt only")

    from jointfit_daemon.tools.replay._player import play_recording

    changes = _changes(file, rig, calibration)
    destination = (base, broker) if mqtt else None
    summary = asyncio.run(play_recording(file, changes, factor, destination, quiet=json))
    typer.echo(orjson.dumps(summary.table()) if json else summary.text())


def _speed(text: str | None, default: float) -> float:
    """Return the factor of the recorded speed; ``max`` is infinity."""
    if text is None:
        return default
    if text == _FASTEST:
        return math.inf
    try:
        factor = float(text)
    except ValueError:
        factor = math.nan
    if not 0.0 < factor < math.inf:
        raise ValueError(f"--speed {text}: expected a number above 0, such as 1 or 20, or max")
    return factor


def _changes(file: Path, rig: Path | None, calibration: str | None) -> Changes:
    from jointfit_daemon.config import load_rig
    from jointfit_daemon.reprocessing import Changes, recorded_rig

    other = None if rig is None else load_rig(rig)
    used = None
    if calibration is not None:
        used = _calibration(calibration, other or recorded_rig(file))
    return Changes(other, used)


def _calibration(given: str, rig: Rig) -> Calibration:
    """Return a stored calibration of the rig, or the calibration in a file.

    Raises
    ------
    ValueError
        The version or the file does not exist or is damaged.
    """
    from jointfit_daemon.calibration.record import CalibrationFileError, CalibrationStore
    from jointfit_daemon.reprocessing import load_calibration
    from jointfit_daemon.supervisor.state_directory import state_directory

    if not given.isdigit():
        return load_calibration(Path(given))
    try:
        store = CalibrationStore(state_directory() / "calibrations", rig.calibration_store)
        return store.load(int(given))
    except CalibrationFileError as error:
        raise ValueError(f"--calibration {given}: {error}") from error


def _verify(file: Path, *, json: bool) -> None:
    from jointfit_daemon.outputs.recording import PROGRAM
    from jointfit_daemon.reprocessing import verify_recording

    began = time.monotonic()
    with show_activity("replaying"):
        found = verify_recording(file)
    took_s = time.monotonic() - began
    if json:
        result = {
            "passed": found.passed,
            "seconds": found.seconds,
            "took_s": took_s,
            "compared": found.compared,
            "until_s": found.until_s,
            "difference": found.difference,
            "gaps": found.gaps,
            "tolerant": found.tolerant,
            "recorded_by": found.program,
            "replayed_by": PROGRAM,
        }
        typer.echo(orjson.dumps(result))
    else:
        for line in found.lines():
            typer.echo(line)
        typer.echo(
            f"{found.seconds:.1f} s replayed in {took_s:.1f} s: {found.seconds / took_s:.0f} × real"
            " time"
        )
    if not found.passed:
        raise typer.Exit(EXIT_FAILED)
