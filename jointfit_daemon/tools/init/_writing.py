"""Writes the files of a complete dialogue (rig and password) and lists the commands to run next."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from jointfit_daemon.config import (
    LATER,
    ConfigError,
    load_rig,
    parse_rig,
    rig_warnings,
)
from jointfit_daemon.tools.init._engine import without_open_places
from jointfit_daemon.tools.init._rig_table import rig_table
from jointfit_daemon.tools.init._rig_text import rig_text
from jointfit_daemon.tools.output_files import replace_file

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.tools.init._answers import Answers
    from jointfit_daemon.tools.init._found import Found


_USUAL_BROKERS = ("mqtt://127.0.0.1:1883", "mqtt://localhost:1883")
"""Addresses of the broker that `jointfit dashboard` uses by default."""


def state_of(path: Path) -> Path:
    """Return the path of the file that stores the answers of an interrupted dialogue."""
    return path.with_suffix(".answers.toml")


def write_password(path: Path, password: str) -> None:
    """Write a password to a new file that only its owner can read."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
        stream.write(f"{password}\n")


@dataclass(frozen=True, slots=True)
class WrittenRig:
    """Result of writing a rig.toml."""

    path: Path
    table: dict[str, Any]
    open_places: tuple[str, ...]
    """Keys whose value is still ``later``, such as ``imu[S1].port``."""
    warnings: tuple[str, ...]
    """Warnings of the check."""
    next_commands: dict[str, str]
    """Commands to run next, each with its purpose."""


def write_rig(path: Path, given: Answers, found: Found) -> WrittenRig:
    """Write the rig; delete the stored answers if no answer was postponed."""
    table = rig_table(given, found)
    replace_file(path, rig_text(table))
    open_places: list[str] = []
    try:
        rig = load_rig(path)
    except ConfigError as error:
        # The check accepted every answer, so only the value ``later`` causes faults here.
        open_places += [fault.key for fault in error.faults if fault.value == LATER]
        if len(open_places) < len(error.faults):
            raise
        rig = parse_rig(rig_table(without_open_places(given, found), found))
    if not open_places:
        state_of(path).unlink(missing_ok=True)

    scheme = "mqtt" if rig.mqtt.tls is None else "mqtts"
    broker = f"{scheme}://{rig.mqtt.host}:{rig.mqtt.tcp_port}"
    option = "" if broker in _USUAL_BROKERS else f" --broker {broker}"
    name = shlex.quote(str(path))
    following = {
        f"jointfit check {name}": "check the file after changes",
        f"jointfitd --config {name}": "run the daemon",
        f"jointfit dashboard{option}": "see the limb and calibrate in a browser",
    }
    if open_places:
        command = f"jointfit init --config {name} --force"
        if path.name == "rig.toml":
            command = f"jointfit init {shlex.quote(str(path.parent))} --force"
        following = {command: "enter the missing values later"} | following
    return WrittenRig(path, table, tuple(open_places), tuple(rig_warnings(rig)), following)
