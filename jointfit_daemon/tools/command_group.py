"""Error handling of the `jointfit` commands, which prints one line on standard error and exits.

Invariant: every command reports errors through `CommandGroup`. Other exceptions are bugs and are
shown with their traceback.
"""

from __future__ import annotations

import errno
import inspect
import os
import sys
from pathlib import Path
from typing import Any

import typer
from typer.core import TyperGroup
from typing_extensions import override

EXIT_FAILED, EXIT_MISUSE, EXIT_INTERRUPTED = 1, 2, 130
EXIT_CODES = (
    "Exit codes: 0 success; 1 failure or refused result; 2 invalid options, or a missing or invalid"
    " file; 3 calibrate: the stored calibration is better and remains active; 128 + N stopped by"
    " signal N (130: Ctrl-C)."
)
_REMEDIES = {
    errno.ENOENT: "check the path",
    errno.EACCES: "change its permissions, or choose another path",
    errno.EPERM: "change its permissions, or choose another path",
    errno.EISDIR: "expected a file, found a folder: add a file name",
    errno.ENOTDIR: "a parent of the path is a file: check the path",
    errno.EEXIST: "choose another path, or remove the existing file",
    errno.ENOSPC: "free some space, or choose another path",
    errno.EROFS: "choose a path on a writable file system",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ELOOP: "the path contains a loop of symbolic links: check the path",
}

ON_DEMAND_ERRORS = (
    (EXIT_MISUSE, "jointfit_daemon.config", "ConfigError"),
    (EXIT_MISUSE, "jointfit_daemon.calibration._errors", "CalibrationError"),
    (EXIT_MISUSE, "jointfit_daemon.files.mocap._c3d", "MissingPackageError"),
    (EXIT_MISUSE, "jointfit_daemon.tools.plotting", "PlottingUnavailableError"),
    (EXIT_MISUSE, "jointfit_daemon.driver", "UnknownDriverError"),
    (EXIT_FAILED, "jointfit_daemon.outputs.mqtt", "BrokerLostError"),
    (EXIT_FAILED, "jointfit_daemon.outputs.mqtt", "NoAnswerError"),
    (EXIT_FAILED, "jointfit_daemon.tools.calibrate", "PhaseAbortedError"),
    (EXIT_FAILED, "jointfit_daemon.tools.calibrate", "RequestRefusedError"),
    (EXIT_FAILED, "jointfit_daemon.tools.child_processes", "ProcessExitedError"),
    (EXIT_FAILED, "jointfit_daemon.tools.child_processes", "DemoTimeoutError"),
    (EXIT_MISUSE, "jointfit_daemon.tools.embedded_broker", "BrokerMissingError"),
    (EXIT_MISUSE, "jointfit_daemon.tools.monitor", "MonitorUnavailableError"),
)
"""Exit code, module and class name of each error whose module is imported on demand."""


def join_lines(text: str) -> str:
    """Join the lines of each paragraph; leave lists and indented examples unchanged."""
    paragraphs = inspect.cleandoc(text).split("\n\n")
    return "\n\n".join(
        paragraph if any(line[:1] in " -*\b" for line in paragraph.split("\n") if line)
        else paragraph.replace("\n", " ")
        for paragraph in paragraphs
    )  # fmt: skip


def is_given(context: typer.Context, parameter: str) -> bool:
    """Return whether a parameter is on the command line, and not only a default value."""
    source = context.get_parameter_source(parameter)
    return source is not None and source.name == "COMMANDLINE"


class CommandGroup(TyperGroup):
    """Runs a command and converts errors that a user can correct into a message."""

    @override
    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return name, command and arguments; a name may have two words."""
        two = " ".join(args[:2])
        if " " in two and two in self.commands:
            return two, self.get_command(ctx, two), args[2:]
        return super().resolve_command(ctx, args)

    @override
    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a command whose help paragraphs are wrapped to the width of the terminal."""
        command = super().get_command(ctx, cmd_name)
        if command is not None and command.help:
            command.help = join_lines(command.help)
        return command

    @override
    def shell_complete(self, ctx: Any, incomplete: str) -> list[Any]:
        """Return the completions that contain no blank; a shell would split other completions."""
        found = super().shell_complete(ctx, incomplete)
        return [item for item in found if " " not in item.value]

    @override
    def invoke(self, ctx: Any) -> Any:
        """Run the selected command; on failure print a message and exit with 1, 2 or 130."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.echo("interrupted", err=True)
            raise typer.Exit(EXIT_INTERRUPTED) from None
        except Exception as error:
            known = _known_error(error)
            if known is None:
                raise
            code, text = known
            # Each line of a configuration error begins with the file name.
            config = sys.modules.get("jointfit_daemon.config")
            named = config is not None and isinstance(error, config.ConfigError)
            if ctx.invoked_subcommand is not None and not named:
                text = f"jointfit {ctx.invoked_subcommand}: {text}"
            typer.echo(text, err=True)
            raise typer.Exit(code) from None
        finally:
            # Discard buffered output of a closed stream; otherwise Python exits with 120.
            for stream in (sys.stdout, sys.stderr):
                try:
                    stream.flush()
                except OSError:
                    with Path(os.devnull).open("wb") as nowhere:
                        os.dup2(nowhere.fileno(), stream.fileno())


def _known_error(error: Exception) -> tuple[int, str] | None:
    """Return exit code and message of an error that a user can correct; None for other errors."""
    if isinstance(error, BrokenPipeError):  # `jointfit schema | head` is no error for the user
        return None
    if isinstance(error, OSError) and error.filename is not None:
        return EXIT_MISUSE, os_error_text(error)
    if isinstance(error, OSError | ValueError):
        return EXIT_MISUSE, str(error)

    # Only a loaded module can have raised the error.
    for code, module, name in ON_DEMAND_ERRORS:
        loaded = sys.modules.get(module)
        if loaded is not None and isinstance(error, getattr(loaded, name)):
            return code, str(error)

    return None


def os_error_text(error: OSError) -> str:
    """Return path, reason and remedy of an operating-system error."""
    remedy = _REMEDIES.get(error.errno or 0, "check the path and the disk")
    return f"{error.filename}: {error.strerror}: {remedy}"
