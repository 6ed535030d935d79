"""The daemon's command line.

Invariant: exit 0 stopped as asked, 1 a bug, 2 usage or configuration, 3 state directory in use.

Starts light: what only a running daemon needs is imported once the configuration is known good.
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

from jointfit_daemon import __version__

if TYPE_CHECKING:
    from collections.abc import Sequence

    from jointfit_daemon.config import Rig

log = logging.getLogger("jointfit_daemon")

EXIT_BUG, EXIT_USAGE, EXIT_IN_USE = 1, 2, 3
LAST_WAIT_S = 2.0
"""How long leaving may wait for a thread: a name lookup cannot be interrupted."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run ``jointfitd`` and return its exit code."""
    options = _parser().parse_args(arguments)
    from jointfit_daemon.config import ConfigError, load_rig

    try:
        rig = load_rig(options.config)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return EXIT_USAGE
    if options.check:
        print(describe(rig))
        return 0
    _start_logging(options.log_level, rig.name)
    if not _own_state():
        return EXIT_IN_USE
    return _run(options.config, rig)


def _own_state() -> bool:
    """Lock the state directory until the process ends; return whether no other daemon has it."""
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
        log.error("%s", error)  # noqa: TRY400 - the traceback would add nothing
        return False
    make_private(state_directory())
    return True


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="jointfitd",
        description="Reads IMUs and motion capture, publishes joint angles over MQTT.",
        epilog="Exit codes: 0 stopped as asked, 1 a bug, 2 wrong options or rig.toml.",
    )
    parser.add_argument("--config", type=Path, required=True, metavar="rig.toml", help="the rig")
    parser.add_argument("--check", action="store_true", help="check the rig and end")
    parser.add_argument(
        "--log-level",
        choices=("debug", "info", "warning", "error"),
        default="info",
        help="least level to log (default: info)",
    )
    parser.add_argument("--version", action="version", version=f"jointfitd {__version__}")
    return parser


def _start_logging(level: str, rig: str) -> None:
    from jointfit_daemon.outputs.log import PrintableRecord

    logging.setLogRecordFactory(PrintableRecord)
    faulthandler.enable()  # the watchdog's SIGABRT leaves a traceback
    logging.basicConfig(
        level=level.upper(), handlers=[_log_handler(rig, all_of_it=level == "debug")]
    )
    logging.getLogger("mqtt").setLevel(logging.ERROR)  # aiomqtt's: we tell its troubles ourselves


def _log_handler(rig: str, *, all_of_it: bool) -> logging.Handler:
    """Return what writes the log: with fields, with levels, or with the time, by who reads it."""
    from jointfit_daemon.outputs.log import (
        JournalHandler,
        LevelFormatter,
        RateLimitedHandler,
        is_journal,
    )

    if is_journal(sys.stderr):
        return JournalHandler(rig, limited=not all_of_it)
    handler = (logging.StreamHandler if all_of_it else RateLimitedHandler)(sys.stderr)
    if "JOURNAL_STREAM" in os.environ or "INVOCATION_ID" in os.environ:
        handler.setFormatter(LevelFormatter())
    else:
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    return handler


def describe(rig: Rig) -> str:
    """Return what a checked rig holds, a line each, for people."""
    chain, mqtt = rig.chain, rig.mqtt
    lines = [f"{rig.name}: good, {rig.output_rate_hz:g} limb states a second"]
    for segment, sensors in zip(chain.segments, chain.sensors, strict=True):
        alone = " (one sensor: no redundancy)" if len(sensors) == 1 else ""
        lines.append(f"  {segment}: {', '.join(sensors)}{alone}")
    lines.append(f"  joints: {', '.join(chain.joints)}")
    for source in rig.sources:
        where = getattr(source.settings, "port", None) or getattr(source.settings, "server", None)
        lines.append(f"  {source.id}: {source.driver}{f' at {where}' if where else ''}")
    if all(source.kind != "mocap" for source in rig.sources):
        lines.append("  no [mocap]: runs on IMUs alone, calibrates by a static pose only")
    lines.append(f"  mqtt {mqtt.version}: {mqtt.host}:{mqtt.tcp_port}, topics {mqtt.base}/…")
    return "\n".join(lines)


def _run(config: Path, rig: Rig) -> int:
    from jointfit_daemon.supervisor.daemon import run_daemon
    from jointfit_daemon.supervisor.process_exit import exit_within

    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # until the daemon takes it: no reload yet
    code = 0
    with asyncio.Runner() as runner:
        try:
            runner.run(run_daemon(config, rig))
        except Exception:
            log.exception("a bug ends the daemon; please report it with what follows")
            code = EXIT_BUG
        exit_within(LAST_WAIT_S, code, "a thread")
    return code


if __name__ == "__main__":
    sys.exit(main())
