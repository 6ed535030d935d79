"""Command `jointfit sample`: writes simulated trials for all commands that read files."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path  # noqa: TC003 - typer reads annotations at run time
from typing import Annotated

import orjson
import typer

from jointfit_daemon.tools.activity import show_activity


def sample(
    folder: Annotated[Path, typer.Argument(help="Output folder, created if missing.")],
    *,
    seed: Annotated[int, typer.Option(help="Random seed: selects the simulated subject.")] = 1,
    force: Annotated[bool, typer.Option("--force", help="Write into a non-empty folder.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print the list of files as JSON.")] = False,
) -> None:
    """Write sample data: short trials of a simulated leg, a chain model, captures and a rig."""
    # The simulator is a separate program that shares no code with the estimators.
    words = [sys.executable, "-m", "jointfit_simulators", "sample", str(folder)]
    words += ["--seed", str(seed), *(["--force"] if force else [])]
    with show_activity("simulating"):
        done = subprocess.run(words, capture_output=True, check=False)  # noqa: S603 - our own program
    if done.returncode:
        why = done.stderr.decode("utf-8", "replace").removeprefix("jointfit-sim: ").strip()
        typer.echo(f"jointfit sample: {why}", err=True)
        raise typer.Exit(done.returncode)

    files: dict[str, str] = orjson.loads(done.stdout)["files"]
    if json:
        typer.echo(orjson.dumps({"folder": str(folder), "files": files}))
        return
    width = max(map(len, files))
    for name, use in files.items():
        typer.echo(f"{name:{width}}  {use}")
