"""Conversion of the chunks of one LSL stream to messages, and of messages to chunks.

The chunks have the format of XDF, the file format of LSL
(https://github.com/sccn/xdf/wiki/Specifications). A chunk consists of the number of length bytes
(1, 4 or 8), the length, a 16-bit tag and the content, all little-endian. Tag 2 is the description
of the stream, and tag 3 contains samples. XDF stores the result of a clock comparison without its
uncertainty. `RoundTrip` therefore also contains the times of request and reply, which bound the
error, and has a separate tag, which XDF readers skip.

Invariant: `LslCodec.feed` never raises. Each call receives a datagram of complete chunks. If a
length or count does not agree with the bytes, the rest of the datagram is discarded.
"""

from __future__ import annotations

import struct
from typing import TYPE_CHECKING, NamedTuple

from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.lsl._description import FORMATS, StreamDescription, parse_description

if TYPE_CHECKING:
    from collections.abc import Sequence

_HEADER, _SAMPLES, _ROUND_TRIP = 2, 3, 0x4A46
_STREAM = 1
"""Number of the stream; there is only one."""
_LENGTHS = {1: struct.Struct("<B"), 4: struct.Struct("<I"), 8: struct.Struct("<Q")}
_START = struct.Struct("<HI")
"""Format of the tag and the number of the stream."""
_TRIP = struct.Struct("<qqd")
_STAMPED = 8
"""Value that marks a sample with a time stamp, which is the number of bytes of the stamp."""


class Samples(NamedTuple):
    """Samples that arrived together."""

    stamps_s: tuple[float, ...]
    """Time stamps as sent, s, on the clock of the sender."""
    values: tuple[tuple[float, ...], ...]
    """One row of `StreamDescription.channel_count` numbers for each time stamp."""


class RoundTrip(NamedTuple):
    """One comparison of the sender's clock with the clock of this host."""

    sent_ns: int
    """Time at which the request was sent, CLOCK_MONOTONIC ns."""
    received_ns: int
    """Time at which the reply arrived, CLOCK_MONOTONIC ns."""
    remote_s: float
    """Time on the clock of the sender in the middle between request and reply, s."""


LslMessage = StreamDescription | Samples | RoundTrip


class LslCodec:
    """Decodes the chunks of one stream.

    Attributes
    ----------
    description : StreamDescription or None
        Most recent description. Without a description, samples cannot be decoded.
    """

    def __init__(self) -> None:
        self.description: StreamDescription | None = None
        self._row: struct.Struct | None = None
        self.messages = 0
        """Number of samples and other well-formed chunks so far."""
        self.discarded = 0
        """Number of bytes so far that belong to no chunk."""
        self.undescribed = 0
        """Number of chunks with samples that arrived before a description."""

    def feed(self, data: bytes) -> list[LslMessage | CorruptBytes]:
        """Return the messages in complete chunks."""
        out: list[LslMessage | CorruptBytes] = []
        at = 0
        while at < len(data):
            found = _content(data, at)
            if isinstance(found, str):
                return self._discard(data, at, found, out)
            message = self._message(data, *found)
            if isinstance(message, str):
                return self._discard(data, at, message, out)
            if message is not None:
                out.append(message)
            self.messages += len(message.stamps_s) if isinstance(message, Samples) else 1
            at = found[2]
        return out

    def _discard(
        self, data: bytes, at: int, reason: str, out: list[LslMessage | CorruptBytes]
    ) -> list[LslMessage | CorruptBytes]:
        """Return `out` with an additional item for the corrupt rest of a datagram."""
        self.discarded += len(data) - at
        out.append(CorruptBytes(len(data) - at, reason))
        return out

    def _message(self, data: bytes, tag: int, begin: int, end: int) -> LslMessage | str | None:
        """Return the message of a chunk, the reason why it is corrupt, or None to skip it."""
        if tag == _SAMPLES:
            return self._samples(data, begin, end)
        if tag == _HEADER:
            description = parse_description(data[begin:end])
            if not isinstance(description, str):
                self.description = description
                code = FORMATS.get(description.channel_format)
                count = description.channel_count
                self._row = None if code is None else struct.Struct(f"<Bd{count}{code}")
            return description
        if tag == _ROUND_TRIP:
            if end - begin != _TRIP.size:
                return f"round trip of {end - begin} bytes"
            return RoundTrip(*_TRIP.unpack_from(data, begin))
        return None

    def _samples(self, data: bytes, begin: int, end: int) -> Samples | str | None:
        if self._row is None:
            self.undescribed += 1
            return None
        size = data[begin] if begin < end else 0
        start = begin + 1 + size
        if size not in _LENGTHS or start > end:
            return "samples without their number"
        # The count is checked before memory is allocated.
        count = _LENGTHS[size].unpack_from(data, begin + 1)[0]
        if count * self._row.size != end - start:
            return f"{count} samples in {end - start} bytes"
        if count == 1:  # the usual chunk
            row = self._row.unpack_from(data, start)
            stamped = row[0] == _STAMPED
            return Samples((row[1],), (row[2:],)) if stamped else "sample without a time stamp"
        rows = tuple(self._row.iter_unpack(memoryview(data)[start:end]))
        if any(row[0] != _STAMPED for row in rows):
            return "sample without a time stamp"
        return Samples(tuple(row[1] for row in rows), tuple(row[2:] for row in rows))


def encode_description(xml: str) -> bytes:
    """Return a chunk that contains a description."""
    return _chunk(_HEADER, xml.encode("utf-8", "replace"))


def encode_samples(
    channel_format: str, stamps_s: Sequence[float], values: Sequence[Sequence[float]]
) -> bytes:
    """Return a chunk that contains samples.

    Parameters
    ----------
    channel_format : str
        A key of `FORMATS`.
    stamps_s : sequence of float
        Time stamps as sent, s.
    values : sequence of sequences of float
        One row for each time stamp.
    """
    row = struct.Struct(f"<Bd{len(values[0]) if values else 0}{FORMATS[channel_format]}")
    packed = (row.pack(_STAMPED, t, *one) for t, one in zip(stamps_s, values, strict=True))
    return _chunk(_SAMPLES, _length(len(stamps_s)) + b"".join(packed))


def encode_round_trip(trip: RoundTrip) -> bytes:
    """Return a chunk that contains a clock comparison."""
    return _chunk(_ROUND_TRIP, _TRIP.pack(*trip))


def _content(data: bytes, at: int) -> tuple[int, int, int] | str:
    """Return tag, begin and end of the content of the chunk at `at`, or why there is no chunk."""
    size = data[at]
    start = at + 1 + size
    if size not in _LENGTHS or start + _START.size > len(data):
        return "no XDF chunk"
    length = _LENGTHS[size].unpack_from(data, at + 1)[0]
    if not _START.size <= length <= len(data) - start:
        return f"chunk states {length} bytes, expected {_START.size} to {len(data) - start}"
    tag, stream = _START.unpack_from(data, start)
    if stream != _STREAM:
        return f"chunk of stream {stream}"
    return tag, start + _START.size, start + length


def _chunk(tag: int, content: bytes) -> bytes:
    return _length(len(content) + _START.size) + _START.pack(tag, _STREAM) + content


def _length(number: int) -> bytes:
    size = 1 if number < 1 << 8 else 4 if number < 1 << 32 else 8
    return bytes([size]) + _LENGTHS[size].pack(number)
