"""Files of a complete dialogue: the rig, the password, and what follows."""

from __future__ import annotations

import os
import shlex
from typing import TYPE_CHECKING

from jointfit_daemon.config import heading_warning, load_rig, missing_files
from jointfit_daemon.tools.init._answer_file import replace_file
from jointfit_daemon.tools.init._rig_table import rig_table
from jointfit_daemon.tools.init._rig_text import rig_text

if TYPE_CHECKING:
    from pathlib import Path

    from jointfit_daemon.config import Rig
    from jointfit_daemon.tools.init._answers import Answers
    from jointfit_daemon.tools.init._found import Found


def state_of(path: Path) -> Path:
    """Return the file with the answers of an interrupted dialogue."""
    return path.with_suffix(".answers.toml")


def write_password(path: Path, password: str) -> None:
    """Write a password to a new file that only its owner can read."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as stream:
        stream.write(f"{password}\n")


def write_rig(path: Path, given: Answers, found: Found) -> tuple[Rig, list[str]]:
    """Write the rig, and return it as the daemon reads it, with the warnings of the check."""
    replace_file(path, rig_text(rig_table(given, found)))
    rig = load_rig(path)
    heading = heading_warning(rig.sources)
    return rig, [*missing_files(rig.mqtt), *([] if heading is None else [heading])]


def next_commands(path: Path, rig: Rig) -> dict[str, str]:
    """Return the commands that follow, with their use."""
    scheme = "mqtt" if rig.mqtt.tls is None else "mqtts"
    broker = f"{scheme}://{rig.mqtt.host}:{rig.mqtt.tcp_port}"
    name = shlex.quote(str(path))
    return {
        f"jointfit check {name}": "check the file after changes",
        f"jointfitd --config {name}": "run the daemon",
        f"jointfit dashboard --broker {broker}": "see the limb and calibrate in a browser",
    }
