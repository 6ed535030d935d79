"""Entry point of the `jointfit` command line, which registers all commands.

Invariant: numpy is not imported before a command runs, because OpenBLAS reads its number of threads
during the import.
"""

from __future__ import annotations

import os

import typer

from jointfit_daemon.tools import fuse
from jointfit_daemon.tools.batch import batch
from jointfit_daemon.tools.calibrate import calibrate
from jointfit_daemon.tools.calibrate_sensor import calibrate_sensor
from jointfit_daemon.tools.center import center
from jointfit_daemon.tools.center_study import center_study
from jointfit_daemon.tools.check import check
from jointfit_daemon.tools.command_group import EXIT_CODES, CommandGroup
from jointfit_daemon.tools.dashboard import dashboard
from jointfit_daemon.tools.decode import decode
from jointfit_daemon.tools.demo import demo
from jointfit_daemon.tools.doctor import doctor
from jointfit_daemon.tools.export import export
from jointfit_daemon.tools.ik import ik
from jointfit_daemon.tools.init import init
from jointfit_daemon.tools.markers import markers
from jointfit_daemon.tools.monitor import monitor
from jointfit_daemon.tools.probe import probe
from jointfit_daemon.tools.record import record
from jointfit_daemon.tools.recover import recover
from jointfit_daemon.tools.replay import replay
from jointfit_daemon.tools.report import report
from jointfit_daemon.tools.request import mark, request
from jointfit_daemon.tools.sample import sample
from jointfit_daemon.tools.schema import schema

app = typer.Typer(
    name="jointfit",
    cls=CommandGroup,
    help="Check a rig, calibrate it, decode captures, process recordings, run a demo.",
    epilog=EXIT_CODES,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for command in (
    init, check, probe, doctor, demo, dashboard, monitor, calibrate, mark, record, request, recover,
    export, center, decode, ik, markers, center_study, sample, schema,
    report, batch, replay,
):  # fmt: skip
    app.command()(command)
app.command("calibrate sensor")(calibrate_sensor)
app.add_typer(fuse.app)


def _print_version(wanted: bool) -> None:
    if wanted:
        from jointfit_daemon import __version__
        from jointfit_variant import running_variant

        typer.echo(f"{__version__} ({running_variant()})")
        raise typer.Exit


@app.callback()
def _shared_options(
    *,
    version: bool = typer.Option(
        False,
        "--version",
        callback=_print_version,
        is_eager=True,
        help="Print the version and exit.",
    ),
) -> None:
    """Define the options of `jointfit` itself."""


def main() -> None:
    """Run the command line with one OpenBLAS thread unless the environment sets a number.

    The matrices of all commands are small. With more threads, `jointfit fuse fit` takes ten times
    the CPU time, because threads wait actively for each other.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    app()


if __name__ == "__main__":
    main()
