"""Command `jointfit markers`: refines marker positions on their segments from motion trials."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast, get_args

import typer

from jointfit_daemon.tools.command_group import EXIT_FAILED, is_given
from jointfit_daemon.tools.markers import _report
from jointfit_daemon.tools.output_files import check_output, check_plot
from jointfit_daemon.tools.text_output import check_choice, echo_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.calibration import RefinementCost, RefinementMethod
    from jointfit_daemon.calibration.marker_refinement import Refinement, RefinementSettings
    from jointfit_daemon.kinematics.chains import ChainModel
    from jointfit_daemon.tools.markers._trials import ModelRequest

Trials = Annotated[list[Path], typer.Argument(help="Training trials, .trc or .c3d.")]
Model = Annotated[Path, typer.Option("--model", help="Chain model: .toml, .json, .osim.")]
Lock = Annotated[
    list[str] | None,
    typer.Option("--lock", help="Lock marker NAME, or one coordinate, such as NAME.x. Repeatable."),
]
Unlock = Annotated[
    list[str] | None,
    typer.Option("--unlock", help="Unlock marker NAME; '*' unlocks all markers. Repeatable."),
]
Without = Annotated[
    list[str] | None,
    typer.Option("--without", help="Ignore marker NAME, for example a computed point. Repeatable."),
]
Validate = Annotated[
    list[Path] | None,
    typer.Option("--validate", help="Validation trial, which the fit does not use. Repeatable."),
]
Method = Annotated[
    str,
    typer.Option(
        "--method", help="joint (markers and poses at once), block (in turns), or search (slow)."
    ),
]
Prior = Annotated[
    float,
    typer.Option(
        "--prior",
        min=0.0,
        help="Cost of a displacement relative to the tracking error; not for search.",
    ),
]
Cost = Annotated[
    str,
    typer.Option(
        "--cost", help="l2: squared errors; l1: distances, so large errors have less influence."
    ),
]
Weights = Annotated[
    Path | None,
    typer.Option("--weights", help="Marker weights: .toml, or .xml of OpenSim's IK tool."),
]
Evenness = Annotated[
    float,
    typer.Option(
        "--evenness",
        min=0.0,
        max=8.0,
        help="Each trial is weighted by its error to this power; not for search.",
    ),
]
Holdout = Annotated[
    float,
    typer.Option(
        "--holdout",
        min=0.0,
        max=0.5,
        help="Share at the end of each trial that is not fitted and decides when the fit stops; not"
        " for search.",
    ),
]
Frames = Annotated[
    int, typer.Option("--frames", min=10, help="Largest number of frames per trial, evenly spaced.")
]
FirstStep = Annotated[
    float, typer.Option("--first-step", help="First step of the search, mm.", min=0.01, max=100.0)
]
Threshold = Annotated[
    float,
    typer.Option("--threshold", help="Step at which the search ends, mm.", min=0.001, max=100.0),
]
Up = Annotated[
    str | None, typer.Option("--up", help="Vertical axis x, y or z, if the files do not define it.")
]
Out = Annotated[
    list[Path] | None,
    typer.Option(
        "--out",
        help="Output file: .toml or .json model, .xml marker set, .trc offsets. Repeatable.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object in SI units.")]
Plot = Annotated[Path | None, typer.Option("--plot", help="Plot the result: .png, .svg or .pdf.")]


def markers(
    context: typer.Context,
    trials: Trials,
    *,
    model: Model,
    lock: Lock = None,
    unlock: Unlock = None,
    without: Without = None,
    validate: Validate = None,
    method: Method = "joint",
    prior: Prior = 0.05,
    cost: Cost = "l2",
    weights: Weights = None,
    evenness: Evenness = 0.0,
    holdout: Holdout = 0.0,
    frames: Frames = 150,
    first_step: FirstStep = 8.0,
    threshold: Threshold = 2.0,
    up: Up = None,
    out: Out = None,
    json: Json = False,
    plot: Plot = None,
) -> None:
    """Refine marker positions on their segments and report the change of the tracking error.

    Exits with 1 if the trials do not fit the model.
    """
    from jointfit_daemon.calibration.marker_refinement import (
        RefinementError,
        RefinementSettings,
        SearchSettings,
    )
    from jointfit_daemon.tools.markers._output import ENDINGS
    from jointfit_daemon.tools.markers._trials import ModelRequest

    chosen = _loss(context, method, cost)
    check_choice("--up", up, "xyz")
    if threshold > first_step:
        raise ValueError(f"--threshold is {threshold:g} mm, expected --first-step or less")
    for path in out or ():
        check_output("--out", path, ENDINGS)
    check_plot(plot)

    names = (tuple(lock or ()), tuple(unlock or ()), tuple(without or ()))
    asked = ModelRequest(model, *names, up or None, weights)
    search = SearchSettings(1e-3 * first_step, 1e-3 * threshold)
    settings = RefinementSettings(
        chosen[0], prior, frames=frames, evenness=evenness, holdout_share=holdout, search=search
    )
    settings = replace(settings, cost=chosen[1])
    try:
        chain, remarks, found = _refine_markers(asked, (trials, validate or []), settings)
    except RefinementError as refused:
        typer.echo(f"jointfit markers: refused: {refused}", err=True)
        raise typer.Exit(EXIT_FAILED) from None
    _write_result(chain, remarks, found, out or (), plot, as_json=json)


def _loss(
    context: typer.Context, method: str, cost: str
) -> tuple[RefinementMethod, RefinementCost]:
    """Return the checked method and cost; refuse other options that the method does not use."""
    from jointfit_daemon.calibration import RefinementCost, RefinementMethod

    check_choice("--method", method, get_args(RefinementMethod))
    check_choice("--cost", cost, get_args(RefinementCost))
    if cost == "l1" and method == "search":
        raise ValueError("--cost l1 is for --method joint or block: search has no loss function")
    _check_options(context, method)
    return cast("RefinementMethod", method), cast("RefinementCost", cost)


def _check_options(context: typer.Context, method: str) -> None:
    """Raise ValueError for an option on the command line that the method does not use."""
    from jointfit_daemon.calibration import METHODS_OF_OPTION

    for name, methods in METHODS_OF_OPTION.items():
        if method not in methods and is_given(context, name):
            option = f"--{name.replace('_', '-')}"
            raise ValueError(
                f"{option} is for --method {' or '.join(methods)}: {method} does not use it; remove"
                " the option, or choose another method"
            )


def _refine_markers(
    asked: ModelRequest, trials: tuple[list[Path], list[Path]], settings: RefinementSettings
) -> tuple[ChainModel, tuple[str, ...], Refinement]:
    from rich.console import Console
    from rich.progress import Progress, TextColumn

    from jointfit_daemon.calibration.marker_refinement import refine_markers
    from jointfit_daemon.tools.markers._trials import load

    chain, remarks, learned, held_out = load(asked, *trials)
    with Progress(
        *Progress.get_default_columns(),
        TextColumn("{task.fields[error]}"),
        console=Console(stderr=True),
        transient=True,
    ) as bar:
        task = bar.add_task("refining", total=1.0, error="")

        def show_progress(share: float, rms: float) -> None:
            bar.update(task, completed=share, error=f"{1000 * rms:.2f} mm")

        return chain, remarks, refine_markers(chain, learned, settings, held_out, show_progress)


def _write_result(
    chain: ChainModel,
    remarks: tuple[str, ...],
    found: Refinement,
    out: Sequence[Path],
    plot: Path | None,
    *,
    as_json: bool,
) -> None:
    from jointfit_daemon.tools.markers._output import write_markers

    if as_json:
        echo_json(_report.as_json(chain, remarks, found))
    else:
        typer.echo(_report.as_text(chain, remarks, found))
    for path in out:
        write_markers(path, chain, found.model)
        typer.echo(f"wrote {path}", err=True)
    if plot is not None:
        from jointfit_daemon.tools.markers._plot import draw_refinement

        draw_refinement(plot, found)
        typer.echo(f"wrote {plot}", err=True)
