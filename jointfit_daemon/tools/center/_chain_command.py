"""The part of `jointfit center` that reconstructs the joints of a chain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import typer

from jointfit_daemon.tools.center import _chain_report
from jointfit_daemon.tools.center.chain import chain_joints, joint_names
from jointfit_daemon.tools.command_group import EXIT_FAILED
from jointfit_daemon.tools.text_output import echo_json

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from jointfit_daemon.files.axes import Axis
    from jointfit_daemon.files.mocap import MarkerTrial


@dataclass(frozen=True, slots=True)
class ChainOptions:
    """Command-line options of `jointfit center` for a chain of segments."""

    segments: Sequence[Sequence[str]]
    joints: Sequence[str]
    plane: Axis | None
    method: str
    trajectory: Path | None
    plot: Path | None
    json: bool


def reconstruct_chain(
    trial: MarkerTrial, source: MarkerTrial | None, options: ChainOptions
) -> None:
    """Print the joints of a chain and write their trajectories and the stick figure.

    Raises
    ------
    typer.Exit
        A joint is refused. The files then contain no positions of this joint.
    """
    asked = [marker for segment in options.segments for marker in segment]
    for read in filter(None, (trial, source)):
        read.points(asked)  # this call reports all unknown names together

    names = joint_names(len(options.segments) - 1, options.joints)
    found = chain_joints(
        trial,
        options.segments,
        names,
        plane=options.plane,
        method=options.method,
        source=source,
    )
    if options.json:
        echo_json(_chain_report.as_json(trial, found))
    else:
        typer.echo(_chain_report.text(trial, found))

    if options.trajectory is not None:
        _chain_report.write_trajectories(options.trajectory, trial, found)
        typer.echo(f"wrote {options.trajectory}", err=True)
    if options.plot is not None:
        from jointfit_daemon.tools.center._stick_figure import draw_stick_figure

        draw_stick_figure(options.plot, trial, options.segments, found, options.plane)
        typer.echo(f"wrote {options.plot}", err=True)
    if any(joint.refused for joint in found):
        raise typer.Exit(EXIT_FAILED)
