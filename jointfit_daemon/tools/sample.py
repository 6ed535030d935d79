"""`jointfit sample`: small simulated trials for every command that reads files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path  # noqa: TC003 - typer reads annotations at run time
from typing import Annotated

import typer


def sample(
    folder: Annotated[Path, typer.Argument(help="Folder for the files; made when absent.")],
    *,
    seed: Annotated[int, typer.Option(help="Another seed is another wearer.")] = 1,
    force: Annotated[
        bool, typer.Option("--force", help="Write into a folder that is not empty.")
    ] = False,
) -> None:
    """Write sample data: short trials of a simulated leg, a chain model, captures and a rig."""
    import orjson

    # the simulator is a program of its own: it shares no code with what is judged on its data
    words = [sys.executable, "-m", "jointfit_simulators", "sample", str(folder)]
    words += ["--seed", str(seed), *(["--force"] if force else [])]
    done = subprocess.run(words, capture_output=True, check=False)  # noqa: S603 - our own program
    if done.returncode:
        why = done.stderr.decode("utf-8", "replace").removeprefix("jointfit-sim: ").strip()
        typer.echo(f"jointfit sample: {why}", err=True)
        raise typer.Exit(done.returncode)

    files: dict[str, str] = orjson.loads(done.stdout)["files"]
    width = max(map(len, files))
    for name, use in files.items():
        typer.echo(f"{name:{width}}  {use}")
