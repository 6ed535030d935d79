"""Commands `jointfit fuse fit|apply|evaluate`: fusion of redundant sensors on recorded trials.

Invariant: a model file is a calibration of the daemon, and `apply` runs the daemon's fusion.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import orjson
import typer

from jointfit_daemon.nearest_name import unknown_name
from jointfit_daemon.tools.activity import show_activity
from jointfit_daemon.tools.fuse import _report
from jointfit_daemon.tools.output_files import check_output, check_plot
from jointfit_daemon.tools.text_output import check_choice, echo_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.calibration.phases import OfflineTrial
    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.limb_model import Calibration
    from jointfit_daemon.tools.fuse._trial import LimbDescription

METHODS_WITHOUT_MOTION = ("mean", "single")
"""Methods that can be fitted without movement."""

app = typer.Typer(
    name="fuse",
    help="Fit, evaluate and apply the fusion of redundant sensors on recorded trials.",
    no_args_is_help=True,
)

Trials = Annotated[
    list[str],
    typer.Argument(
        metavar="SENSORS[=REFERENCE]...",
        help="Sensor file (.npz, .sto) and, if separate, reference file (.npz, .sto, .trc, .c3d).",
    ),
]
Segments = Annotated[
    list[str],
    typer.Option(
        "--segment",
        help="NAME=SENSOR,SENSOR[:BONE], from proximal to distal; BONE is the name of the"
        " segment in the reference, NAME by default.",
    ),
]
Joints = Annotated[
    str | None,
    typer.Option(
        "--joints",
        help="Joint names, one more than segments: hip,knee,ankle. The name sets the sign: knee"
        " flexion is positive backwards.",
    ),
]
Static = Annotated[
    str | None,
    typer.Option(
        "--static",
        help="Static trial SENSORS[=REFERENCE]; a .json file of sensor alignments can replace"
        " SENSORS. Default: alignments are estimated from the movement.",
    ),
]
Markers = Annotated[
    list[str] | None,
    typer.Option("--markers", help="NAME=M1,M2,M3: markers of a segment in .trc and .c3d files."),
]
Up = Annotated[
    str, typer.Option("--up", help="Vertical axis of .sto and .mot files: z, or y (OpenSim).")
]
Lengths = Annotated[
    list[str] | None,
    typer.Option(
        "--length",
        help="SEGMENT=METRES: distance between the joint centers of the segment; repeatable."
        " Needed for joint positions.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object in SI units.")]
Left = Annotated[
    bool,
    typer.Option(
        "--left", help="The limb is a left limb; sets the signs of adduction and rotation."
    ),
]


@app.command()
def evaluate(
    trials: Trials,
    *,
    segment: Segments,
    joints: Joints = None,
    static: Static = None,
    markers: Markers = None,
    up: Up = "z",
    holdout: Annotated[
        float,
        typer.Option(
            "--holdout", min=0.1, max=0.9, help="Held-out share at the end of a single trial."
        ),
    ] = 0.4,
    json: Json = False,
    plot: Annotated[
        Path | None, typer.Option("--plot", help="Plot all methods: .png, .svg or .pdf.")
    ] = None,
) -> None:
    """Evaluate all methods by leave-one-trial-out cross-validation.

    If there is only one trial, the methods are fitted to its beginning and evaluated on its end.
    """
    from jointfit_daemon.calibration.phases import evaluate

    check_plot(plot)
    limb, read, mounts, trial_warnings = _inputs(
        trials, segment, joints, static, markers=markers, up=up
    )
    _refuse_unmoved(limb, read)
    with show_activity("evaluating"):
        found = evaluate(limb.chain, read, mounts, holdout=holdout)
    for warning in trial_warnings:
        typer.echo(f"warning: {warning}", err=True)
    if json:
        echo_json(_report.evaluation_json(found) | {"notes": trial_warnings})
    else:
        typer.echo(_report.evaluation_table(found))
    if plot is not None:
        from jointfit_daemon.tools.fuse._plot import draw_evaluation

        draw_evaluation(plot, found)
        typer.echo(f"wrote {plot}", err=True)


@app.command()
def fit(
    trials: Trials,
    *,
    segment: Segments,
    out: Annotated[Path, typer.Option("--out", help="Model file to write, .json.")],
    method: Annotated[
        str, typer.Option("--method", help="anchored, patent12, patent6, markley, mean or single.")
    ] = "anchored",
    joints: Joints = None,
    static: Static = None,
    markers: Markers = None,
    up: Up = "z",
    length: Lengths = None,
    json: Json = False,
) -> None:
    """Fit a model to all trials and write it as a calibration of the daemon."""
    from datetime import UTC, datetime

    from jointfit_daemon import __version__
    from jointfit_daemon.calibration.phases import fit_offline, mounts_of
    from jointfit_daemon.calibration.soft_tissue import METHODS
    from jointfit_daemon.tools.fuse import _lengths

    check_output("--out", out, (".json",))
    if method not in METHODS:
        raise ValueError(f"--method: {unknown_name('method', method, METHODS)}")
    limb, read, mounts, trial_warnings = _inputs(
        trials, segment, joints, static, markers=markers, up=up
    )
    if method not in METHODS_WITHOUT_MOTION:
        _refuse_unmoved(limb, read)
    files = [_pair(text) for text in (*trials, static) if text is not None]
    lengths = _lengths.segment_lengths(length or (), files, limb)
    mounts = mounts or {s: mean.q for s, mean in mounts_of(limb.chain, read).items()}
    with show_activity("fitting"):
        calibration = fit_offline(
            limb.chain,
            read,
            mounts,
            cast("Any", method),
            lengths=lengths,
            notes=tuple(trial_warnings),
            software=__version__,
            created_utc=datetime.now(UTC).isoformat(timespec="seconds"),
        )
    out.write_bytes(orjson.dumps(calibration.to_dict(), option=orjson.OPT_INDENT_2) + b"\n")
    frames = sum(len(trial.t_s) for trial in read)
    if json:
        shown = {"lengths_m": {segment: found.length for segment, found in lengths.items()}}
        echo_json({"model": str(out), "frames": frames, "notes": trial_warnings} | shown)
    else:
        typer.echo(_report.fit_summary(calibration, frames))
        typer.echo(f"wrote {out}", err=True)


@app.command()
def apply(
    model: Annotated[Path, typer.Argument(help="Model written by `fit`, or stored calibration.")],
    sensors: Annotated[Path, typer.Argument(help="Sensor file, .npz or .sto.")],
    *,
    out: Annotated[
        Path,
        typer.Option(
            "--out", help="File for orientations, angles and positions: .sto, .mot, .npz or .csv."
        ),
    ],
    without: Annotated[
        list[str] | None, typer.Option("--without", help="Sensor to ignore; repeatable.")
    ] = None,
    left: Left = False,
    up: Up = "z",
    length: Lengths = None,
    origin: Annotated[
        str | None,
        typer.Option("--origin", help="X,Y,Z of the first joint, m, z up. Default: 0,0,0."),
    ] = None,
    json: Json = False,
) -> None:
    """Fuse the sensors of a trial as the daemon does: angles and positions with uncertainty.

    Exits with 1 if no frame of a .mot or .sto file is complete.
    """
    from jointfit_daemon.tools.fuse import _lengths, _output
    from jointfit_daemon.tools.fuse._trial import read_available_sensors
    from jointfit_daemon.tools.opensim_tables import report_written, table_notes

    check_output("--out", out, _output.ENDINGS)
    check_choice("--up", up, "yz")
    calibration = _read_model(model)
    axis = cast("Axis", up)
    chain = _output.chain_of(
        calibration,
        left=left,
        lengths=_lengths.parse_lengths(length or (), calibration.segments),
        origin=_lengths.parse_origin(origin),
    )
    table = read_available_sensors(sensors, chain, axis, without or ())
    with show_activity("fusing"):
        found = _output.fuse_trial(calibration, table, chain)
    tables = _output.write_fused(out, found, table, axis)
    found = replace(found, notes=(*found.notes, *table_notes(tables)))
    if json:
        shares = {"known": found.known, "flags": dict(found.flags)}
        files = [str(written.path) for written in tables if written.frames]
        echo_json({"frames": len(found.t_s), **shares, "notes": found.notes, "files": files})
    else:
        typer.echo(_report.fusion_summary(found))
    report_written(tables)


def _read_model(path: Path) -> Calibration:
    """Return the calibration in a model file; raise ValueError if the file contains none."""
    from jointfit_daemon.calibration.record import MOST_BYTES, calibration_of
    from jointfit_daemon.files.text import read_json

    table = read_json(path, MOST_BYTES)
    try:
        return calibration_of(table)
    except (ValueError, RecursionError) as fault:
        raise ValueError(
            f"{path}: expected a model written by `jointfit fuse fit`, or a calibration stored by"
            f" the daemon: {fault}"
        ) from fault


def _inputs(
    trials: Sequence[str],
    segments: Sequence[str],
    joints: str | None,
    static: str | None,
    *,
    markers: Sequence[str] | None,
    up: str,
) -> tuple[LimbDescription, list[OfflineTrial], dict[str, Any] | None, list[str]]:
    """Return limb, trials, sensor alignments and warnings.

    The alignments are None if they must be estimated from the trials.
    """
    from jointfit_daemon.calibration.phases import trial_warnings
    from jointfit_daemon.tools.fuse import _trial

    check_choice("--up", up, "yz")
    limb = _trial.read_limb(segments, joints, markers or (), cast("Axis", up))
    mounts, still = None, None
    if static is not None:
        mounts, still = _trial.read_static(*_pair(static), limb)
    read = [_trial.read_trial(*_pair(text), limb, still) for text in trials]
    read = _trial.name_trials(read, [_pair(text)[0] for text in trials])
    warnings = trial_warnings(limb.chain, read, mounts)
    if mounts is None:
        warnings.append(
            "no --static: sensor alignments are estimated from the movement and the reference, so"
            " results hold for this sensor placement only"
        )
    return limb, read, mounts, warnings


def _pair(text: str) -> tuple[Path, Path | None]:
    sensors, equals, reference = text.partition("=")
    return Path(sensors), Path(reference) if equals else None


def _refuse_unmoved(limb: LimbDescription, trials: Sequence[OfflineTrial]) -> None:
    from jointfit_daemon.calibration.phases import unmoved_joint

    if why := unmoved_joint(limb.chain, trials):
        raise ValueError(why)
