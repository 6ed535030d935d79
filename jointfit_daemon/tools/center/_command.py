"""Command `jointfit center`: centre of rotation of a joint from a marker trial (C3D or TRC)."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003 - typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated, cast

import typer

from jointfit_daemon.tools.command_group import EXIT_FAILED
from jointfit_daemon.tools.output_files import check_plot
from jointfit_daemon.tools.text_output import check_choice, echo_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.files.mocap import MarkerTrial
    from jointfit_daemon.tools.center.trial import ParentFrameMotion, WindowEstimate


def center(
    trial: Annotated[Path, typer.Argument(help="Marker trial, .c3d or .trc.")],
    *,
    parent: Annotated[
        str, typer.Option("--parent", help="Parent markers M1,M2,M3; M1,M2 with --plane.")
    ],
    markers: Annotated[str, typer.Option("--markers", help="Child markers M4,M5,...")],
    method: Annotated[
        str,
        typer.Option(
            "--method",
            help="sphere, score, sara, halvorsen, ...; with --plane hyper, pratt, taubin, kasa, "
            "geometric, ...; auto selects one.",
        ),
    ] = "auto",
    plane: Annotated[
        str | None,
        typer.Option("--plane", help="Planar movement: the file's axis normal to the plane."),
    ] = None,
    window: Annotated[
        float | None, typer.Option("--window", min=0.05, help="Estimate per window of SECONDS.")
    ] = None,
    up: Annotated[
        str | None, typer.Option("--up", help="Vertical axis, if the file does not define it.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object in SI units.")] = False,
    plot: Annotated[
        Path | None, typer.Option("--plot", help="Plot markers and centre: .png, .svg or .pdf.")
    ] = None,
) -> None:
    """Estimate the centre of rotation of a joint, with its uncertainty.

    The centre is given in the frame of the parent's markers. Exits with 1 if every estimate is
    refused.
    """
    from jointfit_daemon.files.mocap import read_marker_trial
    from jointfit_daemon.tools.center.trial import answers, reduce

    check_choice("--plane", plane, "xyz")
    check_choice("--up", up, "xyz")
    check_plot(plot)

    read = read_marker_trial(trial, cast("Axis | None", up))
    asked = _names(parent), _names(markers)
    read.points([*asked[0], *asked[1]])  # reports all unknown names at once
    reduced = reduce(read, *asked, cast("Axis | None", plane))
    found = list(answers(read, reduced, method, window))

    _print(read, asked, reduced, found, as_table=window is not None, as_json=json)
    if plot is not None:
        from jointfit_daemon.tools.center._plot import draw_center

        draw_center(plot, reduced, asked[1], found, f"{trial.name}: {found[0].estimate.method}")
        typer.echo(f"wrote {plot}", err=True)
    if all(answer.estimate.refused for answer in found):
        raise typer.Exit(EXIT_FAILED)


def _names(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    return list(dict.fromkeys(names))


def _print(
    trial: MarkerTrial,
    asked: tuple[list[str], list[str]],
    reduced: ParentFrameMotion,
    found: Sequence[WindowEstimate],
    *,
    as_table: bool,
    as_json: bool,
) -> None:
    from jointfit_daemon.tools.center import _report

    if as_json:
        echo_json(_report.as_json(trial, *asked, reduced, found))
        return
    typer.echo(_report.head(trial, *asked, reduced))
    if as_table:
        typer.echo(f"method    {found[0].estimate.method}\n")
        typer.echo(_report.windows(found))
    else:
        typer.echo(_report.details(found[0]))
