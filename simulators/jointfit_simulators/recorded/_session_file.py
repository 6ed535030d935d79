"""Reads the rig and the chunks of all sources in a recording, with the MCAP library."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import orjson
from mcap.exceptions import McapError
from mcap.reader import make_reader

if TYPE_CHECKING:
    from pathlib import Path

_SOURCE = "source/"
"""Prefix of the channel names that contain chunks."""
_RIG = "rig.json"
"""Name of the attachment with the parsed rig.toml."""
_PART_NAME = re.compile(r"(.+-\d{8}T\d{6})-\d{4,}\.mcap")


class UnplayableRecordingError(ValueError):
    """The file is not a recording, is damaged, or has devices that cannot be simulated."""


@dataclass(frozen=True, slots=True)
class RecordedSession:
    """Rig of a session, and the data that its devices sent."""

    rig: dict[str, Any]
    """Parsed content of rig.toml."""
    chunks: dict[str, list[tuple[int, bytes]]]
    """Chunks by source: arrival time since the first chunk of all sources, ns, and bytes."""


def read_session_chunks(path: Path) -> RecordedSession:
    """Return the rig and the chunks of a recording; `path` is a file or folder of a session.

    Raises
    ------
    UnplayableRecordingError
        The file is not a recording, or is damaged.
    OSError
        The file cannot be read.
    """
    rig: dict[str, Any] | None = None
    found: dict[str, list[tuple[int, bytes]]] = {}
    for file in _files_of(path):
        try:
            with file.open("rb") as stream:
                reader = make_reader(stream, validate_crcs=True)
                for attachment in reader.iter_attachments():
                    if attachment.name == _RIG and rig is None:
                        rig = orjson.loads(attachment.data)
                for _, channel, message in reader.iter_messages():
                    if channel.topic.startswith(_SOURCE):
                        source = channel.topic.removeprefix(_SOURCE)
                        found.setdefault(source, []).append((message.log_time, message.data))
        except (McapError, ValueError, EOFError) as error:
            raise UnplayableRecordingError(
                f"{file}: cannot be read ({str(error) or type(error).__name__:.200}): expected a "
                "complete recording. `jointfit recover` writes one from a damaged file"
            ) from error

    if rig is None or not found:
        what = "rig" if rig is None else "bytes of devices"
        raise UnplayableRecordingError(
            f"{path}: the recording contains no {what}: choose another recording"
        )
    begin_ns = min(chunks[0][0] for chunks in found.values())
    return RecordedSession(
        rig,
        {source: [(t_ns - begin_ns, data) for t_ns, data in found[source]] for source in found},
    )


def _files_of(path: Path) -> list[Path]:
    """Return the files of the session to which `path` belongs, in order."""
    match = None if path.is_dir() else _PART_NAME.fullmatch(path.name)
    if match is None and not path.is_dir():
        return [path]
    folder = path if path.is_dir() else path.parent
    files = sorted(file for file in folder.iterdir() if _PART_NAME.fullmatch(file.name))
    if match is not None:
        return [file for file in files if file.name.startswith(f"{match[1]}-")]
    if not files:
        raise UnplayableRecordingError(
            f"{path}: the folder contains no complete recording (NAME.mcap): stop the recording, or"
            " name its file"
        )
    return files
