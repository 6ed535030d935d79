"""Command `jointfit center-study`: repeats the numerical experiment of Akbarifar et al. (2021).

The experiment determines the errors of circle fits that estimate a centre of rotation.
"""

from __future__ import annotations

from pathlib import Path  # noqa: TC003 - typer reads annotations at run time
from typing import Annotated

import orjson
import typer

from jointfit_daemon.tools.output_files import check_output


def center_study(
    *,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for figures (PNG, SVG) and text.")
    ] = None,
    json: Annotated[
        Path | None, typer.Option("--json", help="File for all results, including the error maps.")
    ] = None,
    repeats: Annotated[
        int,
        typer.Option(
            "--repeats", min=2, help="Number of random runs for each cell of an error map."
        ),
    ] = 1000,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Random seed.")] = 1,
) -> None:
    """Repeat a published experiment on centres of rotation: tables, and figures with --out."""
    from rich.console import Console
    from rich.progress import Progress

    from jointfit_daemon.center_of_rotation.study import StudySetup, extend_study, run_study
    from jointfit_daemon.tools.center_study._plot import draw_study
    from jointfit_daemon.tools.center_study.tables import as_json, tables
    from jointfit_daemon.tools.plotting import PlottingUnavailableError

    if json is not None:
        check_output("--json", json, (json.suffix.lower(),))
    if out is not None:  # Check the folder before the long computation.
        out.mkdir(parents=True, exist_ok=True)

    plain = StudySetup()
    setup = StudySetup(
        repeats=repeats,
        grid_repeats=min(plain.grid_repeats, repeats),
        frames_repeats=min(plain.frames_repeats, repeats),
        seed=seed,
    )
    console = Console(stderr=True)
    with Progress(console=console, transient=True, disable=not console.is_terminal) as bar:
        task = bar.add_task("computing nine maps", total=1.0)
        study = run_study(setup, lambda share: bar.update(task, completed=share))

    more = extend_study(setup)
    text = tables(setup, study, more)
    typer.echo(text, nl=False)

    if json is not None:
        json.write_bytes(orjson.dumps(as_json(setup, study, more), option=orjson.OPT_INDENT_2))
    if out is None:
        return
    (out / "cor-study.txt").write_text(text, encoding="utf-8")
    try:
        for path in draw_study(study, out):
            typer.echo(f"wrote {path}", err=True)
    except PlottingUnavailableError as missing:
        typer.echo(f"no figures: {missing}", err=True)
