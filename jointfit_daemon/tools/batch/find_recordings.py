"""Search for recordings below a folder; all parts of a session are one recording."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from jointfit_daemon.tools.batch.recording_task import RecordingTask

if TYPE_CHECKING:
    from pathlib import Path

_PART = re.compile(r"(?P<session>.+-\d{8}T\d{6})-(?P<number>\d{4,})\.mcap(\.part)?")
"""Pattern of the file name of one part of a recorded session."""
_ENDINGS = (".mcap", ".mcap.part", ".jsonl")
"""File-name extensions of recordings."""


def find_recordings(
    folder: Path, out: Path, steps: tuple[str, ...], formats: tuple[str, ...]
) -> list[RecordingTask]:
    """Return one task for each recorded session below `folder`, in the order of their names.

    Files in the output folder and in hidden folders are ignored.
    """
    sessions: dict[str, list[tuple[int, str]]] = {}
    for path in sorted(folder.rglob("*")):
        relative = path.relative_to(folder)
        hidden = any(part.startswith(".") for part in relative.parts)
        if hidden or not path.name.endswith(_ENDINGS) or out in path.parents or not path.is_file():
            continue
        found = _PART.fullmatch(path.name)
        name = found["session"] if found else path.name.split(".mcap")[0].removesuffix(".jsonl")
        key = relative.with_name(name).as_posix()
        sessions.setdefault(key, []).append((int(found["number"]) if found else 0, str(path)))
    return [
        RecordingTask(name, tuple(path for _, path in sorted(parts)), str(out), steps, formats)
        for name, parts in sorted(sessions.items())
    ]
