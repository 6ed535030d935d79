"""Chunks of XDF files: packing of chunks, and reading of streams from the chunks.

A file is ``XDF:`` followed by chunks. A chunk consists of the number of length bytes (1, 4 or 8),
the length, a 16-bit tag and the content. Source: https://github.com/sccn/xdf/wiki/Specifications.

Invariants: the memory used is proportional to the size of the file, whatever length a chunk
declares. A truncated file, or a file of another format, raises `MalformedFileError`.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from typing import TYPE_CHECKING
from xml.etree import ElementTree as ET

import numpy as np

from jointfit_daemon.files.text import MalformedFileError, reject_device

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from jointfit_daemon.arrays import Array

MAGIC = b"XDF:"
FILE_HEADER, STREAM_HEADER, SAMPLES, CLOCK_OFFSET, BOUNDARY, STREAM_FOOTER = range(1, 7)
_LENGTHS = {1: "<B", 4: "<I", 8: "<Q"}
"""Format codes of a length (module `struct`), by the number of length bytes."""
FORMATS = {
    "float32": "<f4", "double64": "<f8",
    "int8": "<i1", "int16": "<i2", "int32": "<i4", "int64": "<i8",
}  # fmt: skip
STRING = "string"
_LARGEST_XML = 16 << 20
"""Largest XML header of a stream, bytes."""
_MOST_CHANNELS = 1 << 16


@dataclass(slots=True)
class XdfStream:
    """Content of a stream as written in the file."""

    header: ET.Element
    t_s: list[Array] = field(default_factory=list)
    """Time stamps of each chunk, s, on the clock of the sender, shape (n,). NaN marks a sample
    without a stamp in the file. Its time follows from the last stamp before it and the nominal
    rate."""
    values: list[Array] = field(default_factory=list)
    """Samples of each chunk, shape (n, channels). Empty for a stream that contains strings."""
    texts: list[list[str]] = field(default_factory=list)
    """Samples of a stream that contains strings."""
    offsets: list[tuple[float, float]] = field(default_factory=list)
    """Pairs of measurement time and clock offset, s."""

    def text(self, path: str) -> str:
        """Return the text of an element of the header; empty if missing."""
        return (self.header.findtext(path) or "").strip()

    @property
    def channels(self) -> int:
        """Number of channels."""
        count = self.text("channel_count")
        return min(int(count), _MOST_CHANNELS) if count.isdecimal() else 0

    @property
    def rate_hz(self) -> float:
        """Nominal rate, Hz; 0 for irregular samples."""
        try:
            rate = float(self.text("nominal_srate") or 0.0)
        except ValueError:
            return 0.0
        return rate if 0.0 < rate < float("inf") else 0.0


def pack_chunk(tag: int, content: bytes) -> bytes:
    """Return the bytes of a chunk."""
    return _length(len(content) + 2) + struct.pack("<H", tag) + content


def pack_text(text: str) -> bytes:
    """Return the bytes of one value of a stream of strings."""
    data = text.encode()
    return _length(len(data)) + data


def pack_samples(t_s: Array, values: Array) -> bytes:
    """Return the content of a chunk with samples of doubles, without the number of the stream."""
    rows = np.empty(
        len(t_s), dtype=[("stamped", "u1"), ("t_s", "<f8"), ("values", "<f8", values.shape[1:])]
    )
    rows["stamped"], rows["t_s"], rows["values"] = 8, t_s, values
    return _length(len(t_s)) + rows.tobytes()


def _length(number: int) -> bytes:
    size = 1 if number < 1 << 8 else 4 if number < 1 << 32 else 8
    return bytes([size]) + struct.pack(_LENGTHS[size], number)


def read_xdf_streams(path: Path) -> tuple[ET.Element, list[XdfStream]]:
    """Return the header and the streams of a file.

    Raises
    ------
    MalformedFileError
        The file is not an XDF file, is truncated, or contains samples that contradict their stream.
    """
    reject_device(path)
    data = path.read_bytes()
    if not data.startswith(MAGIC):
        raise MalformedFileError(
            f"{path}: not an XDF file: found {data[:4]!r}, expected {MAGIC!r}: export it again"
        )
    streams: dict[int, XdfStream] = {}
    header = ET.Element("info")
    for at, tag, content in _chunks(path, data):
        try:
            if tag == FILE_HEADER:
                header = _xml(content)
            elif tag in (STREAM_HEADER, SAMPLES, CLOCK_OFFSET):
                number = struct.unpack_from("<I", content)[0]
                if tag == STREAM_HEADER:
                    streams[number] = XdfStream(_xml(content[4:]))
                else:
                    _add(streams[number], tag, content[4:])
        except (struct.error, ValueError, KeyError, IndexError, ET.ParseError) as fault:
            raise MalformedFileError(
                f"{path}: damaged chunk at byte {at} (tag {tag}): copy or export the file again"
            ) from fault
    return header, list(streams.values())


def _chunks(path: Path, data: bytes) -> Iterator[tuple[int, int, memoryview]]:
    """Yield position, tag and content of every chunk."""
    at = len(MAGIC)
    view = memoryview(data)
    while at < len(data):
        size = data[at]
        start = at + 1 + size
        if size not in _LENGTHS:
            raise MalformedFileError(
                f"{path}: byte {at} is {size}, expected a chunk whose length has 1, 4 or 8 bytes:"
                " copy or export the file again"
            )
        length = struct.unpack_from(_LENGTHS[size], data, at + 1)[0] if start <= len(data) else 2
        if length < 2 or start + length > len(data):  # noqa: PLR2004 - size of the tag
            raise MalformedFileError(
                f"{path}: cut off: the chunk at byte {at} declares {length} bytes,"
                f" {max(len(data) - start, 0)} follow: copy or export the file again"
            )
        tag = int.from_bytes(data[start : start + 2], "little")
        yield at, tag, view[start + 2 : start + length]
        at = start + length


def _xml(content: memoryview) -> ET.Element:
    text = bytes(content)
    # A document type can define entities, and a short text with nested entities can expand to
    # gigabytes.
    if len(text) > _LARGEST_XML or b"<!" in text:
        raise ValueError("header too long, or with a document type")
    return ET.fromstring(text)  # noqa: S314 - without a document type there are no entities


def _add(stream: XdfStream, tag: int, content: memoryview) -> None:
    if tag == CLOCK_OFFSET:
        stream.offsets.append(struct.unpack_from("<dd", content))
        return
    size = content[0]
    count = struct.unpack_from(_LENGTHS[size], content, 1)[0]
    body = content[1 + size :]
    kind = stream.text("channel_format")
    if kind == STRING:
        _add_texts(stream, body, count)
        return

    item = np.dtype((FORMATS[kind], (stream.channels,)))
    stamped = np.dtype([("stamped", "u1"), ("t_s", "<f8"), ("values", item)])
    if len(body) == count * stamped.itemsize:
        rows = np.frombuffer(body, stamped)
        if (rows["stamped"] == 8).all():  # noqa: PLR2004 - bytes of a time stamp
            stream.t_s.append(rows["t_s"].astype(np.float64))
            stream.values.append(rows["values"].astype(np.float64).reshape(count, -1))
            return

    # At least one of the samples has no time stamp.
    at, times, values = 0, [], []
    for _ in range(count):
        t_s, at = _stamp(body, at)
        times.append(t_s)
        values.append(np.frombuffer(body, item, 1, at)[0].astype(np.float64))
        at += item.itemsize
    stream.t_s.append(np.array(times, np.float64))
    stream.values.append(np.array(values, np.float64).reshape(count, -1))


def _add_texts(stream: XdfStream, body: memoryview, count: int) -> None:
    at, times = 0, []
    for _ in range(count):
        t_s, at = _stamp(body, at)
        times.append(t_s)
        row = []
        for _ in range(stream.channels):
            size = body[at]
            length = struct.unpack_from(_LENGTHS[size], body, at + 1)[0]
            at += 1 + size + length
            if at > len(body):
                raise ValueError("text longer than its chunk")
            row.append(bytes(body[at - length : at]).decode("utf-8", "replace"))
        stream.texts.append(row)
    stream.t_s.append(np.array(times, np.float64))


def _stamp(body: memoryview, at: int) -> tuple[float, int]:
    """Return the time stamp of a sample, s, and the position after it; NaN if absent."""
    if body[at] == 0:
        return float("nan"), at + 1
    return struct.unpack_from("<d", body, at + 1)[0], at + 9
