"""The `jointfit` commands. Law: one module a command; heavy imports wait for the command."""

from __future__ import annotations

import os

import typer

from jointfit_daemon import __version__
from jointfit_daemon.tools import (
    calibrate,
    center,
    check,
    decode,
    demo,
    fuse,
    markers,
    report,
    sample,
    schema,
)
from jointfit_daemon.tools.command_group import EXIT_CODES, CommandGroup

app = typer.Typer(
    name="jointfit",
    cls=CommandGroup,
    help="Tools around jointfitd: check a rig, calibrate it, decode captures, see a demo.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
app.command(name="check")(check.check)
app.command(name="demo")(demo.demo)
app.command(name="calibrate")(calibrate.calibrate)
app.command(name="center")(center.center)
app.command(name="decode")(decode.decode)
app.add_typer(fuse.app)
app.command(name="markers")(markers.markers)
app.command(name="report")(report.report)
app.command(name="sample")(sample.sample)
app.command(name="schema")(schema.schema)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(__version__)
        raise typer.Exit


@app.callback()
def _options(
    *,
    version: bool = typer.Option(
        False, "--version", callback=_version, is_eager=True, help="Print the version and exit."
    ),
) -> None:
    """Take the options that every command shares."""


def main() -> None:
    """Run the command line, with one thread of linear algebra unless the environment asks for more.

    OpenBLAS reads the number when numpy is imported, which commands do. Their matrices are small:
    `jointfit fuse fit` takes ten times the CPU time where threads wait for each other.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    app()


if __name__ == "__main__":
    main()
