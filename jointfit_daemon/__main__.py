"""The command line of ``jointfitd``.

Invariant: the exit code is 0 after a requested stop, 1 after a bug, 2 for wrong options or a faulty
configuration, and 3 if another daemon uses the state directory. Modules that only a running daemon
needs are imported after the configuration was checked.
"""

from __future__ import annotations

import argparse
import asyncio
import faulthandler
import logging
import os
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.config import Rig

log = logging.getLogger("jointfit_daemon")

EXIT_BUG, EXIT_USAGE, EXIT_IN_USE = 1, 2, 3
THREADS_TIMEOUT_S = 2.0
"""Longest wait for threads at the end of the process, s. A thread that resolves a host name cannot
be interrupted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``jointfitd`` and return its exit code."""
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.version:
        from jointfit_daemon import __version__
        from jointfit_variant import running_variant

        print(f"jointfitd {__version__} ({running_variant()})")
        return 0
    if options.config is None:
        parser.error("the following arguments are required: --config")

    from jointfit_daemon.config import ConfigError, load_rig

    try:
        rig = load_rig(options.config)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return EXIT_USAGE
    if options.check:
        try:
            print(rig_summary(rig), flush=True)
        except BrokenPipeError:  # discard the rest of the output, as in `... --check | head`
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0

    from jointfit_daemon.outputs.log import PrintableRecord

    logging.setLogRecordFactory(PrintableRecord)
    faulthandler.enable()  # log a traceback on the watchdog's SIGABRT
    logging.basicConfig(
        level=options.log_level.upper(),
        handlers=[_log_handler(rig.name, limited=options.log_level != "debug")],
    )
    # The daemon reports connection faults itself, so aiomqtt's logger reports errors only.
    logging.getLogger("mqtt").setLevel(logging.ERROR)

    if not _lock_state_directory():
        return EXIT_IN_USE
    return _run(options.config, rig)


def _lock_state_directory() -> bool:
    """Lock the state directory for this process; return False if another daemon uses it."""
    from jointfit_daemon.supervisor.state_directory import (
        PRIVATE_UMASK,
        StateDirectoryInUseError,
        lock_state,
        make_private,
        state_directory,
    )

    os.umask(PRIVATE_UMASK)  # calibrations and recordings are personal data
    try:
        lock_state(state_directory())
    except StateDirectoryInUseError as error:
        log.error("%s", error)  # noqa: TRY400 - not a bug, so no traceback
        return False
    make_private(state_directory())
    return True


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jointfitd",
        usage="%(prog)s [-h] --config rig.toml [--check] [--log-level LEVEL] [--version]",
        description="Read IMUs and motion capture, publish joint angles over MQTT.",
        epilog="Exit codes: 0 stopped, 1 bug, 2 options or rig.toml, 3 state directory in use.",
    )
    parser.add_argument(
        "--config", type=Path, metavar="rig.toml", help="configuration of the rig (required)"
    )
    parser.add_argument("--check", action="store_true", help="check rig.toml and exit")
    parser.add_argument(
        "--log-level",
        choices=("debug", "info", "warning", "error"),
        default="info",
        help="lowest level of log lines (default: info)",
    )
    parser.add_argument("--version", action="store_true", help="print the version and exit")
    return parser


def _log_handler(rig: str, *, limited: bool) -> logging.Handler:
    """Return the log handler for the destination of standard error.

    The destination is the systemd journal, another output of a systemd service such as a file, or a
    terminal.
    """
    from jointfit_daemon.outputs.log import (
        JournalHandler,
        LevelFormatter,
        RateLimitedHandler,
        is_journal,
    )

    if is_journal(sys.stderr):
        return JournalHandler(rig, limited=limited)
    handler = (RateLimitedHandler if limited else logging.StreamHandler)(sys.stderr)
    if "JOURNAL_STREAM" in os.environ or "INVOCATION_ID" in os.environ:
        handler.setFormatter(LevelFormatter())
    elif sys.stderr.isatty() and limited:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(message)s", "%H:%M:%S"))
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    return handler


def rig_summary(rig: Rig) -> str:
    """Return a summary of a valid rig for the terminal, one line per item."""
    chain, mqtt = rig.chain, rig.mqtt
    lines = [f"{rig.name}: valid, {rig.output_rate_hz:g} limb states per second"]
    for segment, sensors in zip(chain.segments, chain.sensors, strict=True):
        note = " (one sensor: no redundancy)" if len(sensors) == 1 else ""
        lines.append(f"  {segment}: {', '.join(sensors)}{note}")
    lines.append(f"  joints: {', '.join(chain.joints)}")
    for source in rig.sources:
        where = getattr(source.settings, "port", None) or getattr(source.settings, "server", None)
        lines.append(f"  {source.id}: {source.driver}{f' at {where}' if where else ''}")
    if all(source.kind != "mocap" for source in rig.sources):
        lines.append("  no [mocap]: IMUs only, calibration by a static pose only")
    lines.append(f"  mqtt {mqtt.version}: {mqtt.host}:{mqtt.tcp_port}, topics {mqtt.base}/…")
    return "\n".join(lines)


def _run(config: Path, rig: Rig) -> int:
    from jointfit_daemon.supervisor.daemon import run_daemon
    from jointfit_daemon.supervisor.process_exit import ExitLimit

    # SIGHUP requests a reload. Without a handler it would end the process, so it is ignored until
    # the daemon installs its handler.
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    code = 0
    with asyncio.Runner() as runner:
        try:
            runner.run(run_daemon(config, rig))
        except Exception:
            log.exception("the daemon ends because of a bug; please report it with this traceback")
            code = EXIT_BUG
        ExitLimit(THREADS_TIMEOUT_S, code, "a thread").start()
    return code


if __name__ == "__main__":
    sys.exit(main())
