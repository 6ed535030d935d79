"""Command `jointfit ik`: computes joint coordinates of a marker trial by inverse kinematics."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from jointfit_daemon.tools.activity import show_activity
from jointfit_daemon.tools.command_group import EXIT_FAILED
from jointfit_daemon.tools.output_files import check_output
from jointfit_daemon.tools.text_output import check_choice, echo_json

Trial = Annotated[Path, typer.Argument(help="Marker trial, .trc or .c3d.")]
Model = Annotated[Path, typer.Argument(help="Chain model: .osim, .toml, .json.")]
Out = Annotated[
    list[Path] | None,
    typer.Option(
        "--out", help="File for the coordinates: .mot or .sto (OpenSim), .csv. Repeatable."
    ),
]
Errors = Annotated[
    Path | None,
    typer.Option(
        "--errors", help="File for RMS and largest marker error per frame: .sto, .mot, .csv."
    ),
]
Weight = Annotated[
    list[str] | None,
    typer.Option("--weight", help="Weight of a marker: NAME=2; 0 excludes it. Repeatable."),
]
Setup = Annotated[
    Path | None,
    typer.Option(
        "--setup", help="OpenSim IK set-up file; its marker weights and time range are used."
    ),
]
Without = Annotated[
    list[str] | None,
    typer.Option("--without", help="Ignore marker NAME, for example a computed point. Repeatable."),
]
Start = Annotated[float | None, typer.Option("--start", help="Time of the first frame, s.")]
End = Annotated[float | None, typer.Option("--end", help="Time of the last frame, s.")]
Limits = Annotated[
    bool,
    typer.Option("--limits/--no-limits", help="Restrict coordinates to the limits of the model."),
]
Sd = Annotated[
    bool, typer.Option("--sd", help="Add a column NAME_sd: standard deviation of a coordinate.")
]
Radians = Annotated[bool, typer.Option("--radians", help="Write radians instead of degrees.")]
Up = Annotated[
    str | None,
    typer.Option("--up", help="Vertical axis x, y or z, if the file does not define it."),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object in SI units.")]


def ik(
    trial: Trial,
    model: Model,
    *,
    out: Out = None,
    errors: Errors = None,
    weight: Weight = None,
    setup: Setup = None,
    without: Without = None,
    start: Start = None,
    end: End = None,
    limits: Limits = True,
    sd: Sd = False,
    radians: Radians = False,
    up: Up = None,
    json: Json = False,
) -> None:
    """Compute the joint coordinates of a marker trial by inverse kinematics.

    The command compares the marker errors with the limits that OpenSim recommends. Errors above
    these limits do not change the exit code. The exit code is 1 if the trial does not belong to the
    model (other markers, unit or size), or if no frame of a .mot or .sto file is complete.
    """
    from jointfit_daemon.calibration.marker_refinement import RefinementError
    from jointfit_daemon.tools.ik._output import ENDINGS, write_tables
    from jointfit_daemon.tools.ik._report import as_json, as_text
    from jointfit_daemon.tools.ik._solution import IkRequest, solve_trial
    from jointfit_daemon.tools.opensim_tables import report_written, table_notes

    check_choice("--up", up, "xyz")
    for path in out or ():
        check_output("--out", path, ENDINGS)
    check_output("--errors", errors, ENDINGS)

    asked = IkRequest(
        trial,
        model,
        weights=tuple(weight or ()),
        setup=setup,
        without=tuple(without or ()),
        span=(start, end),
        use_limits=limits,
        up=up,
    )
    try:
        with show_activity("solving"):
            found = solve_trial(asked)
    except RefinementError as refused:
        typer.echo(f"jointfit ik: refused: {refused}", err=True)
        raise typer.Exit(EXIT_FAILED) from None

    tables = write_tables(found, out or (), errors, with_sd=sd, in_degrees=not radians)
    found = replace(found, notes=(*found.notes, *table_notes(tables)))
    if json:
        echo_json(as_json(found))
    else:
        typer.echo(as_text(found))
    report_written(tables)
