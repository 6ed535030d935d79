"""Command `jointfit center`: centre of rotation of a joint from a marker trial (C3D or TRC)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from jointfit_daemon.tools.activity import show_activity
from jointfit_daemon.tools.command_group import EXIT_FAILED
from jointfit_daemon.tools.output_files import check_output, check_plot
from jointfit_daemon.tools.text_output import check_choice, echo_json

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.files.mocap import MarkerTrial
    from jointfit_daemon.tools.center.trial import ParentFrameMotion, WindowEstimate


_Parent = Annotated[
    str | None,
    typer.Option("--parent", help="Markers of the parent segment: M1,M2,M3; with --plane M1,M2."),
]
_Children = Annotated[
    str | None, typer.Option("--markers", help="Markers of the child segment: M4,M5,...")
]
_Segments = Annotated[
    list[str] | None,
    typer.Option(
        "--segment",
        help="Markers of one segment of a chain, instead of --parent and --markers; repeat the"
        " option from one end of the chain to the other.",
    ),
]
_Joints = Annotated[
    str | None,
    typer.Option("--joints", help="Names of the joints of the chain, separated by commas."),
]
_Trajectory = Annotated[
    Path | None,
    typer.Option("--trajectory", help="Write the joint positions of all frames: .trc or .csv."),
]
_Source = Annotated[
    Path | None,
    typer.Option("--centers-from", help="Estimate the centres of the chain from this trial."),
]
_Method = Annotated[
    str,
    typer.Option(
        "--method",
        help="Estimator: sphere, score, sara, halvorsen, ...; with --plane hyper, pratt, taubin, "
        "kasa, geometric, ...; auto selects an estimator.",
    ),
]
_Plane = Annotated[
    str | None,
    typer.Option(
        "--plane", help="For planar movement: axis of the file normal to the plane, x, y or z."
    ),
]
_Window = Annotated[
    float | None,
    typer.Option("--window", min=0.05, help="One estimate per window of this duration, s."),
]
_Up = Annotated[
    str | None,
    typer.Option("--up", help="Vertical axis x, y or z, if the file does not define it."),
]
_Plot = Annotated[
    Path | None,
    typer.Option(
        "--plot", help="Plot the centre, or the chain as a stick figure: .png, .svg or .pdf."
    ),
]


def center(
    trial: Annotated[Path, typer.Argument(help="Marker trial, .c3d or .trc.")],
    *,
    parent: _Parent = None,
    markers: _Children = None,
    segment: _Segments = None,
    joints: _Joints = None,
    trajectory: _Trajectory = None,
    source: _Source = None,
    method: _Method = "auto",
    plane: _Plane = None,
    window: _Window = None,
    up: _Up = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON in SI units.")] = False,
    plot: _Plot = None,
) -> None:
    """Estimate the centre of rotation of a joint, with its uncertainty.

    The centre is given in the frame that the parent markers define. With --segment, all joints of a
    chain are estimated, and --trajectory writes their positions in every frame. Exits with 1 if
    every estimate, or a joint of the chain, is refused.
    """
    from jointfit_daemon.files.mocap import read_marker_trial
    from jointfit_daemon.tools.center._chain_command import ChainOptions, reconstruct_chain
    from jointfit_daemon.tools.center._chain_report import ENDINGS

    check_choice("--plane", plane, "xyz")
    check_choice("--up", up, "xyz")
    check_plot(plot)
    check_output("--trajectory", trajectory, ENDINGS)

    vertical, normal = cast("Axis | None", up), cast("Axis | None", plane)
    if segment or trajectory is not None:
        segments = _segments(parent, markers, segment, window)
        names = _words(joints or "")
        options = ChainOptions(segments, names, normal, method, trajectory, plot, json)
        wide = None if source is None else read_marker_trial(source, vertical)
        reconstruct_chain(read_marker_trial(trial, vertical), wide, options)
        return

    if unused := [o for o, v in (("--joints", joints), ("--centers-from", source)) if v]:
        raise ValueError(f"{unused[0]} is for a chain: name its segments with --segment")
    if parent is None or markers is None:
        raise ValueError(
            "expected --parent and --markers for one joint, or --segment for each segment of a"
            " chain: name the markers"
        )

    asked = _names(parent), _names(markers)
    read = read_marker_trial(trial, vertical)
    with show_activity("estimating"):
        reduced, found = _one_joint(read, asked, normal, method, window)
    _print(read, asked, reduced, found, as_table=window is not None, as_json=json)
    if plot is not None:
        from jointfit_daemon.tools.center._plot import draw_center

        draw_center(plot, reduced, asked[1], found, f"{trial.name}: {found[0].estimate.method}")
        typer.echo(f"wrote {plot}", err=True)
    if all(answer.estimate.refused for answer in found):
        raise typer.Exit(EXIT_FAILED)


def _one_joint(
    trial: MarkerTrial,
    asked: tuple[list[str], list[str]],
    normal: Axis | None,
    method: str,
    window: float | None,
) -> tuple[ParentFrameMotion, list[WindowEstimate]]:
    from jointfit_daemon.tools.center.trial import answers, reduce

    trial.points([*asked[0], *asked[1]])  # reports all unknown names at once
    reduced = reduce(trial, *asked, normal)
    return reduced, list(answers(trial, reduced, method, window))


def _segments(
    parent: str | None, markers: str | None, segment: list[str] | None, window: float | None
) -> list[list[str]]:
    """Return the markers of each segment; --parent and --markers are a chain of two segments."""
    if window is not None:
        raise ValueError(
            "--window is for one joint: omit --window, or omit --segment and --trajectory"
        )
    if segment and (parent or markers):
        raise ValueError("--segment names the whole chain: omit --parent and --markers")
    if segment:
        return [_words(text) for text in segment]
    if parent is None or markers is None:
        raise ValueError(
            "--trajectory needs a chain: name its segments with --segment, from one end to the"
            " other"
        )
    return [_names(parent), _names(markers)]


def _names(text: str) -> list[str]:
    return list(dict.fromkeys(_words(text)))


def _words(text: str) -> list[str]:
    return [word.strip() for word in text.split(",") if word.strip()]


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
