"""Reader of recordings, including damaged recordings and those of a crashed or running daemon.

Invariant: messages are returned in the order in which the daemon processed them. Each missing
message is part of exactly one `RecordingGap`.
"""

from __future__ import annotations

import re
import struct
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, lru_cache
from io import BytesIO
from typing import TYPE_CHECKING, Any, NamedTuple

import orjson
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel

from jointfit_daemon.model import Chunk
from jointfit_daemon.outputs.recording._blocks import (
    AttachmentBlock,
    ChunkBlock,
    DamagedBlock,
    EndBlock,
    MetadataBlock,
    RecordingError,
    read_blocks,
)
from jointfit_daemon.outputs.recording._channels import (
    CHANNEL_METADATA,
    END_METADATA,
    EVENT,
    FORMAT,
    GAP,
    RECORDING_METADATA,
    SNAPSHOT,
    SOURCE,
    STATE,
)
from jointfit_daemon.outputs.recording._description import RecordingGap, RecordingInfo, unseal
from jointfit_daemon.outputs.recording._event_json import DamagedEventError, decode_event
from jointfit_daemon.outputs.recording._part_file import UNFINISHED
from jointfit_daemon.pipeline.events import ChunkArrived

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping
    from pathlib import Path

    from jointfit_daemon.pipeline.events import Event

_PART_NAME = re.compile(r"(?P<stem>.+-\d{8}T\d{6})-(?P<part>\d{4,})\.mcap(\.part)?")
"""Pattern of the names of a session's files."""
_MESSAGE = struct.Struct("<BQHIQQ")
"""Format of opcode, length, channel, sequence number, log time and publish time of a message."""
_PREFIX = struct.Struct("<BQ")
_MESSAGE_OPCODE = int(Opcode.MESSAGE)  # comparing an enumeration is slow
_RESTORING = {SNAPSHOT, GAP.partition("/")[0] + "/"}
"""Prefixes of channels whose messages have no sequence number of their own."""
_SEQUENCES, _HALF = 2**32, 2**31


class RecordedMessage(NamedTuple):
    """One message of a recording."""

    sequence: int
    """Number of the message in the session. A snapshot has the number of the message that follows
    it."""
    channel: str
    t_ns: int
    """Instant of arrival, CLOCK_MONOTONIC ns."""
    publish_t_ns: int
    """Time to which the content refers, CLOCK_MONOTONIC ns; the arrival if this time is unknown."""
    data: bytes

    def event(self) -> Event | None:
        """Return the input event of the core; None for other messages.

        Raises
        ------
        RecordingError
            The content cannot be converted to an event.
        ConfigError
            The rig of the recording cannot be loaded, for example because a driver is missing.
        """
        prefix, name = _channel_parts(self.channel)
        if prefix == SNAPSHOT and name.startswith(SOURCE):
            prefix, name = SOURCE, name.removeprefix(SOURCE)
        if prefix == SOURCE:
            return ChunkArrived(name, Chunk(self.t_ns, self.data))
        if prefix in {EVENT, SNAPSHOT}:
            try:
                return decode_event(name, self.data)
            except DamagedEventError as error:
                raise RecordingError(f"message {self.sequence}: {error}") from error
        return None


@lru_cache(maxsize=256)
def _channel_parts(channel: str) -> tuple[str, str]:
    """Return the prefix of a channel, including its slash, and the rest of the name."""
    prefix, slash, name = channel.partition("/")
    return prefix + slash, name


@dataclass(frozen=True)
class RecordedPart:
    """One readable file of a recording."""

    path: Path
    info: RecordingInfo
    documents: Mapping[str, bytes]
    """Attachments by name, such as ``rig.json``."""

    def messages(self) -> Iterator[RecordedMessage | DamagedBlock | PartEnd]:
        """Yield all messages of this file, its damaged ranges, and its end."""
        topics: dict[int, str] = {}
        expected, offset_ns = self.info.first_sequence, self.info.unix_offset_ns
        end = PartEnd(None, "", complete=False)
        for block in read_blocks(self.path):
            match block:
                case ChunkBlock(content=content):
                    for message in _messages(content, topics, expected, offset_ns):
                        expected = message.sequence
                        yield message
                case MetadataBlock(name=name, values=values):
                    end = _read_metadata(name, values, topics) or end
                case DamagedBlock():
                    yield block
                case EndBlock():
                    end = end._replace(complete=True)
        yield end

    def survey(self) -> PartSurvey:
        """Read the whole file; return its end and its damaged ranges."""
        found = [item for item in self.messages() if isinstance(item, DamagedBlock | PartEnd)]
        (end,) = [item for item in found if isinstance(item, PartEnd)]
        return PartSurvey([item for item in found if isinstance(item, DamagedBlock)], end)


class PartSurvey(NamedTuple):
    """Damaged ranges and end of a file."""

    damage: list[DamagedBlock]
    end: PartEnd


class PartEnd(NamedTuple):
    """End of a file."""

    next_sequence: int | None
    """Sequence number after the last message; None if the file was not closed."""
    reason: str
    """Reason of the end: ``rotated``, ``stopped``, ``recovered``, or empty."""
    complete: bool
    """Whether the file has its regular end."""


def _read_metadata(name: str, values: dict[str, str], topics: dict[int, str]) -> PartEnd | None:
    try:
        if name == CHANNEL_METADATA:
            found = unseal(values)
            topics.setdefault(int(found["id"]), found["topic"])
        if name == END_METADATA:
            found = unseal(values)
            return PartEnd(int(found["next_sequence"]), found["reason"], complete=False)
    except (ValueError, KeyError):  # damaged; the chunks also contain the channels
        return None
    return None


def _messages(
    content: bytes, topics: dict[int, str], expected: int, offset_ns: int
) -> Iterator[RecordedMessage]:
    """Yield the messages of a chunk, and add its channels to `topics`.

    The checksum of the chunk is correct, so only a file made by hand can contain a wrong length.
    """
    place, size = 0, len(content)
    while place + _PREFIX.size <= size:
        opcode, length = _PREFIX.unpack_from(content, place)
        end = place + _PREFIX.size + length
        if end > size:
            return
        if opcode == _MESSAGE_OPCODE and length >= _MESSAGE.size - _PREFIX.size:
            _, _, number, low, log_ns, publish_ns = _MESSAGE.unpack_from(content, place)
            # The file stores numbers modulo 2**32. The step from the previous number is far
            # smaller than this modulus.
            expected += (low - expected + _HALF) % _SEQUENCES - _HALF
            data = content[place + _MESSAGE.size : end]
            yield RecordedMessage(
                expected, topics.get(number, ""), log_ns - offset_ns, publish_ns - offset_ns, data
            )
        elif opcode == Opcode.CHANNEL:
            try:
                record = content[place + _PREFIX.size : end]
                channel = Channel.read(ReadDataStream(BytesIO(record)))
            except Exception:  # noqa: BLE001 - made by hand: its messages have no name
                channel = None
            if channel is not None:
                topics[channel.id] = channel.topic
        place = end


@dataclass(frozen=True)
class Recording:
    """All files of one session."""

    parts: tuple[RecordedPart, ...]

    @property
    def info(self) -> RecordingInfo:
        """Description of the first file."""
        return self.parts[0].info

    @property
    def name(self) -> str:
        """Name of the rig, ``[rig] name``."""
        return self.info.rig

    @property
    def start_unix_ns(self) -> int:
        """UNIX time at which the first file begins, ns."""
        return self.info.start_t_ns + self.info.unix_offset_ns

    @property
    def began_with_daemon(self) -> bool:
        """Whether the files contain every event since the start of the daemon."""
        return self.info.began_with_daemon and self.info.part == 1

    @cached_property
    def rig_table(self) -> dict[str, Any] | None:
        """The parsed rig.toml at the start of the recording; None if it is not recorded."""
        with suppress(ValueError, KeyError):
            table = orjson.loads(self.parts[0].documents["rig.json"])
            return table if isinstance(table, dict) else None
        return None

    def messages(self) -> Iterator[RecordedMessage | RecordingGap]:
        """Yield all messages in the order of processing, and the gaps between them.

        Snapshots are yielded only at the beginning and after gaps. Elsewhere, the preceding events
        have the same content.

        Raises
        ------
        RecordingError
            A file is damaged in too many places.
        OSError
            A file cannot be read.
        """
        sequencer = _Sequencer(self.info)
        for part in self.parts:
            sequencer.damage = ""
            for item in part.messages():
                if isinstance(item, RecordedMessage) and sequencer.continues(item):
                    yield item
                else:
                    yield from sequencer.follow(item)

    def events(self) -> Iterator[Event]:
        """Yield the input events of the core in order.

        The errors are those of `messages` and of `RecordedMessage.event`.
        """
        for message in self.messages():
            if isinstance(message, RecordedMessage):
                event = message.event()
                if event is not None:
                    yield event

    def states(self) -> Iterator[bytes]:
        """Yield the limb states as written by `encode_state`."""
        for message in self.messages():
            if isinstance(message, RecordedMessage) and message.channel == STATE:
                yield message.data

    def gaps(self) -> list[RecordingGap]:
        """Read all files and return all gaps."""
        return [message for message in self.messages() if isinstance(message, RecordingGap)]


class _Sequencer:
    """Detects gaps by the sequence numbers, and selects the snapshots that are necessary."""

    def __init__(self, info: RecordingInfo) -> None:
        self._expected = info.first_sequence
        self._t_ns = info.start_t_ns
        self._restoring = True
        self.damage = ""
        """Most recent damaged range, which is the reason of the next gap."""

    def continues(self, item: RecordedMessage) -> bool:
        """Return whether a message follows the previous message without a gap.

        If so, its number is stored. The result is False for snapshots.
        """
        if item.sequence != self._expected or _channel_parts(item.channel)[0] in _RESTORING:
            return False
        self._expected, self._t_ns, self._restoring = item.sequence + 1, item.t_ns, False
        return True

    def follow(
        self, item: RecordedMessage | DamagedBlock | PartEnd
    ) -> Iterator[RecordedMessage | RecordingGap]:
        """Process the next item of a file; yield its message and the gap before it, if any."""
        if isinstance(item, DamagedBlock):
            self.damage = f"bytes {item.start} to {item.end} are damaged: {item.reason}"
        elif isinstance(item, PartEnd):
            if item.next_sequence is not None and item.next_sequence > self._expected:
                yield self._gap(item.next_sequence, self._t_ns, self.damage)
        elif item.channel == GAP or item.channel.startswith(SNAPSHOT):
            if item.sequence > self._expected:
                reason = self.damage
                if item.channel == GAP:
                    # A file that was edited by hand may contain a gap without a reason.
                    reason = ""
                    with suppress(ValueError, KeyError, TypeError):
                        reason = str(orjson.loads(item.data)["reason"])
                yield self._gap(item.sequence, item.t_ns, reason)
            if item.channel != GAP and self._restoring:
                yield item
        else:
            if item.sequence > self._expected:
                yield self._gap(item.sequence, item.t_ns, self.damage)
            self._expected, self._t_ns = item.sequence + 1, item.t_ns
            self._restoring = False
            yield item

    def _gap(self, following: int, t_ns: int, reason: str) -> RecordingGap:
        count, first = following - self._expected, self._expected
        self._expected, self._restoring, self.damage = following, True, ""
        reason = reason or "a file of the session is missing"
        return RecordingGap(first, count, self._t_ns, t_ns, reason)


def open_recording(path: Path) -> Recording:
    """Return the recording at `path`, without reading its messages.

    Parameters
    ----------
    path
        Any file of a session, or a folder with the files of exactly one session. The other files of
        the session are found by their names.

    Raises
    ------
    RecordingError
        A file is not a recording, or was written by a later version; or the folder does not
        contain exactly one recording.
    OSError
        A file cannot be read.
    """
    parts: list[RecordedPart] = []
    for file in session_files(path):
        try:
            part = open_part(file)
        except RecordingError:
            if file == path:
                raise
            continue  # another session, or a file without a message
        if not parts or part.info.session == parts[0].info.session:
            parts.append(part)
    if not parts:
        raise RecordingError(f"{path}: the folder contains no recording (NAME.mcap)")
    return Recording(tuple(sorted(parts, key=lambda part: part.info.part)))


def session_files(path: Path) -> list[Path]:
    """Return the files that belong to the session of `path` by their names.

    Raises
    ------
    RecordingError
        `path` is a folder with files of several sessions.
    """
    if path.is_dir():
        stems = {m["stem"] for m in map(_name_match, path.iterdir()) if m is not None}
        if len(stems) > 1:
            listed = ", ".join(sorted(stems)[:5])
            raise RecordingError(f"{path}: {len(stems)} recordings: name one of {listed}")
        found = [other for other in path.iterdir() if _name_match(other) is not None]
    else:
        match = _name_match(path)
        if match is None:
            return [path]
        found = [
            other
            for other in path.parent.iterdir()
            if (one := _name_match(other)) is not None and one["stem"] == match["stem"]
        ]

    # A file that was renamed during the listing is used once.
    complete = {other.name for other in found}
    return sorted(p for p in found if p.name.removesuffix(UNFINISHED) not in complete - {p.name})


def _name_match(path: Path) -> re.Match[str] | None:
    return _PART_NAME.fullmatch(path.name)


def open_part(path: Path) -> RecordedPart:
    """Return one file of a recording.

    Raises
    ------
    RecordingError
        The file is not a recording, or was written by a later version.
    OSError
        The file cannot be read.
    """
    info: RecordingInfo | None = None
    documents: dict[str, bytes] = {}
    for block in read_blocks(path):
        match block:
            case MetadataBlock(name=name, values=values) if name == RECORDING_METADATA:
                info = info or _read_info(path, values)
            case AttachmentBlock(attachment=attachment):
                documents[attachment.name] = attachment.data
            case ChunkBlock():
                break
    if info is None:
        raise RecordingError(f"{path}: the description of the recording is missing or damaged")
    return RecordedPart(path, info, documents)


def _read_info(path: Path, values: dict[str, str]) -> RecordingInfo | None:
    """Return the description in a metadata record; None if it is damaged.

    Every file contains a second copy of its description.
    """
    try:
        version = int(unseal(values)["format"])
    except (ValueError, KeyError):
        return None
    if version > FORMAT:
        raise RecordingError(
            f"{path}: a recording of format {version}, expected at most {FORMAT}: a later "
            "jointfitd wrote it; update this one"
        )
    try:
        return RecordingInfo.from_metadata(values)
    except ValueError:
        return None


def read_events(path: Path) -> Iterator[Event]:
    """Yield the input events of the recording at `path` in order; see `Recording.events`.

    Raises
    ------
    RecordingError
        The file is not a recording, was written by a later version, or contains a damaged event.
    ConfigError
        The rig of the recording cannot be loaded, for example because a driver is missing.
    OSError
        The file cannot be read.
    """
    yield from open_recording(path).events()
