"""Reading of the records of a recording. Damaged records are reported and skipped.

Invariant: whatever a file contains, the only exception is `RecordingError`, and the memory used is
at most one record of `MOST_RECORD_BYTES` and its decompressed content.
"""

from __future__ import annotations

import re
import struct
import zlib
from io import BytesIO
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk, Header, Metadata
from mcap.writer import MCAP0_MAGIC

from jointfit_daemon.outputs.recording._channels import PROFILE

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path
    from typing import BinaryIO

MOST_RECORD_BYTES = 64 * 1024 * 1024
"""Largest record, and largest content of a chunk, bytes. The recorder writes chunks of 1 MiB."""
_PREFIX = struct.Struct("<BQ")
"""Format of the opcode and the length of a record."""
_RECORD_START = re.compile(
    rb"\x06.{7}\0.{28}\x04\0\0\0zstd|\x0c.{5}\0\0\0.\0\0\0jointfit\.", re.DOTALL
)
"""Pattern of the start of a compressed chunk, or of a recording's metadata."""
_LONGEST_START = 64
"""Number of bytes, larger than the length of every match of `_RECORD_START`."""
_WINDOW_BYTES = 1024 * 1024
"""Number of bytes that are searched in one step."""
_MOST_WASTED_RATIO = 20
"""Largest ratio of the bytes read in damaged records to the size of the file. It limits the time
that reading a malicious file can take."""


class RecordingError(ValueError):
    """The file is not a recording, or this version cannot read it."""


class ChunkBlock(NamedTuple):
    """A chunk whose checksum is correct."""

    start: int
    """Position of the chunk in the file, bytes."""
    end: int
    content: bytes
    """Decompressed records of the chunk."""


class MetadataBlock(NamedTuple):
    """A metadata record."""

    start: int
    end: int
    name: str
    values: dict[str, str]


class AttachmentBlock(NamedTuple):
    """An attachment whose checksum is correct."""

    start: int
    end: int
    attachment: Attachment


class DamagedBlock(NamedTuple):
    """A range of bytes that contains no readable record."""

    start: int
    end: int
    reason: str


class EndBlock(NamedTuple):
    """The regular end of the file."""

    end: int


Block: TypeAlias = ChunkBlock | MetadataBlock | AttachmentBlock | DamagedBlock | EndBlock


class _DamageError(ValueError):
    """A record is damaged. Before the error, `read_bytes` bytes of its content were read."""

    def __init__(self, text: str, read_bytes: int = 0) -> None:
        super().__init__(text)
        self.read_bytes = read_bytes


def read_blocks(path: Path) -> Iterator[Block]:
    """Yield chunks, metadata and attachments of a file in order, and the damage between them.

    Raises
    ------
    RecordingError
        The file is not a recording of jointfitd, or is damaged in too many places.
    OSError
        The file cannot be read.
    """
    with path.open("rb") as file:
        size = file.seek(0, 2)
        place = _check_header(file, path, size)
        most_wasted_bytes = _MOST_WASTED_RATIO * size + _WINDOW_BYTES
        while place < size:
            try:
                block, following = _read_record(file, place, size)
            except _DamageError as damage:
                most_wasted_bytes -= damage.read_bytes
                if most_wasted_bytes < 0:
                    raise RecordingError(f"{path}: damaged in too many places to be read") from None
                following = _find_record(file, place + 1, size)
                block = DamagedBlock(place, following, str(damage))
            if block is not None:
                yield block
            place = following


def _check_header(file: BinaryIO, path: Path, size: int) -> int:
    """Check the magic bytes and the header; return the position of the first record."""
    if size == 0:
        raise RecordingError(f"{path}: the file is empty")
    file.seek(0)
    start = file.read(len(MCAP0_MAGIC) + _PREFIX.size)
    if not start.startswith(MCAP0_MAGIC[: len(start)]):
        raise RecordingError(f"{path}: not a recording: it does not begin like an MCAP file")
    if len(start) < len(MCAP0_MAGIC) + _PREFIX.size:
        raise RecordingError(f"{path}: it ends after {size} bytes, before its first message")

    opcode, length = _PREFIX.unpack(start[len(MCAP0_MAGIC) :])
    content = file.read(min(length, _LONGEST_HEADER))
    try:
        if opcode != Opcode.HEADER or len(content) != length:
            raise _DamageError("no header")
        profile = Header.read(_stream(content)).profile
    except _READING_ERRORS as error:
        raise RecordingError(f"{path}: the header of the MCAP file is damaged") from error
    if profile != PROFILE:
        raise RecordingError(
            f"{path}: an MCAP file with the profile {profile[:40]!r}, expected {PROFILE!r}: it was "
            "not recorded by jointfitd"
        )
    return len(start) + len(content)


_LONGEST_HEADER = 4096
"""Largest length of the header, bytes."""


def _read_record(file: BinaryIO, place: int, size: int) -> tuple[Block | None, int]:
    """Return the record at `place` and the next position; the record is None for unused kinds."""
    file.seek(place)
    prefix = file.read(_PREFIX.size)
    if prefix.startswith(MCAP0_MAGIC) and place + len(MCAP0_MAGIC) == size:
        return EndBlock(size), size
    if len(prefix) < _PREFIX.size:
        raise _DamageError("the file ends within a record")
    opcode, length = _PREFIX.unpack(prefix)
    if opcode == Opcode.MESSAGE_INDEX and not _starts_message_index(
        prefix + file.read(_MESSAGE_INDEX.size - _PREFIX.size)
    ):
        raise _DamageError("the lengths in a message index contradict each other")
    end = place + _PREFIX.size + length
    if end > size:
        raise _DamageError("the file ends within a record, or the length of a record is damaged")
    if opcode not in _READERS:
        return None, end
    if length > MOST_RECORD_BYTES:
        raise _DamageError(f"a record of {length} bytes; the longest permitted one has 64 MiB")

    content = file.read(length)
    try:
        return _READERS[opcode](place, end, content), end
    except _READING_ERRORS as error:
        # If another record begins at the expected position, the length is correct.
        if _starts_record(file, end, size):
            return DamagedBlock(place, end, f"a damaged record: {error}"), end
        raise _DamageError(f"a damaged record: {error}", length) from error


def _starts_record(file: BinaryIO, place: int, size: int) -> bool:
    file.seek(place)
    start = file.read(_LONGEST_START)
    return (
        place == size
        or _RECORD_START.match(start) is not None
        or start[:1] == _DATA_END
        or _starts_message_index(start)
    )


_DATA_END = bytes([Opcode.DATA_END])
_MESSAGE_INDEX = struct.Struct("<BQHI")
"""Format of opcode, length, channel and size of the entries of a message index."""


def _starts_message_index(start: bytes) -> bool:
    """Return whether the two lengths in a message index agree; the record has no checksum."""
    if len(start) < _MESSAGE_INDEX.size:
        return False
    opcode, length, _, entries_bytes = _MESSAGE_INDEX.unpack_from(start)
    own_bytes = _MESSAGE_INDEX.size - _PREFIX.size
    return bool(opcode == Opcode.MESSAGE_INDEX and length == own_bytes + entries_bytes)


def _find_record(file: BinaryIO, place: int, size: int) -> int:
    """Return the position of the next record found, or the end of the file if there is none."""
    while place < size:
        file.seek(place)
        window = file.read(_WINDOW_BYTES + _LONGEST_START)
        for match in _RECORD_START.finditer(window):
            length = _PREFIX.unpack_from(window, match.start())[1]
            if place + match.start() + _PREFIX.size + length <= size:
                return place + match.start()
        place += _WINDOW_BYTES
    return size


def _read_chunk(start: int, end: int, content: bytes) -> Block:
    chunk = Chunk.read(_stream(content))
    if 40 + len(chunk.compression.encode()) + len(chunk.data) != len(content):
        raise _DamageError("the lengths in a chunk contradict each other")
    if chunk.uncompressed_size > MOST_RECORD_BYTES:
        raise _DamageError(f"a chunk of {chunk.uncompressed_size} bytes; at most 64 MiB are read")

    data = chunk.data
    if chunk.compression == "zstd":
        # If the declared sizes of the zstd data and of the chunk differ, the data could expand to
        # any size.
        if zstandard.get_frame_parameters(data).content_size != chunk.uncompressed_size:
            raise _DamageError("a chunk and its compressed data declare different sizes")
        # A new decompressor is used, because a shared decompressor is not thread-safe.
        data = zstandard.ZstdDecompressor(max_window_size=MOST_RECORD_BYTES).decompress(data)
    elif chunk.compression:
        raise _DamageError(f"unknown compression {chunk.compression[:20]!r}")
    if zlib.crc32(data) != chunk.uncompressed_crc:
        raise _DamageError("the checksum of a chunk is wrong")
    return ChunkBlock(start, end, data)


def _read_metadata(start: int, end: int, content: bytes) -> Block:
    stream = _stream(content)
    metadata = Metadata.read(stream)
    if stream.count != len(content):
        raise _DamageError("the lengths in metadata contradict each other")
    return MetadataBlock(start, end, metadata.name, metadata.metadata)


def _read_attachment(start: int, end: int, content: bytes) -> Block:
    if zlib.crc32(content[:-4]) != int.from_bytes(content[-4:], "little"):
        raise _DamageError("the checksum of an attachment is wrong")
    return AttachmentBlock(start, end, Attachment.read(_stream(content)))


_READERS = {
    Opcode.CHUNK: _read_chunk,
    Opcode.METADATA: _read_metadata,
    Opcode.ATTACHMENT: _read_attachment,
}
"""Opcodes of the records that are read. All other records repeat the content of these records."""
_READING_ERRORS = (
    ValueError,
    OverflowError,
    McapError,
    struct.error,
    zstandard.ZstdError,
    MemoryError,
)
"""Exceptions of the libraries for damaged content; ValueError includes UnicodeDecodeError."""


def _stream(content: bytes) -> ReadDataStream:
    return ReadDataStream(BytesIO(content))
