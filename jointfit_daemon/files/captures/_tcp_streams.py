"""Conversion of TCP segments to a byte stream for each direction of a connection, and to packets.

Each retransmitted segment is used once, and late segments are sorted into the stream. A capture may
begin in the middle of a connection, or have holes, where segments are missing. The bytes after a
hole do not continue the bytes before it. Most servers begin a packet with a new segment, so the
search for packets restarts at the first segment after the hole.

Invariant: all functions are pure; at most `_MOST_WAITING` segments of a direction wait for an
earlier segment.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple, Protocol

from jointfit_daemon.model import Chunk

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from jointfit_daemon.files.captures._packet_capture import TcpSegment

_NUMBERS = 1 << 32
_MOST_WAITING = 256
"""Largest number of segments that wait for an earlier segment. With more waiting segments, the
earlier segment counts as lost."""


class LostBytes(Protocol):
    """Bytes that belong to no packet."""

    @property
    def discarded(self) -> int:
        """Number of bytes."""


class Splitter(Protocol):
    """Splits the bytes of a connection into packets, as a `PacketStream` does."""

    broken: bool

    def feed(self, data: bytes) -> Sequence[bytes | LostBytes]:
        """Return the packets that `data` completes."""

    def flush(self) -> Sequence[LostBytes]:
        """Discard an incomplete packet."""


class Piece(NamedTuple):
    """Consecutive bytes in one direction of a connection."""

    t_ns: int
    data: bytes
    continues: bool
    """Whether no byte is missing before this piece."""


def directions(segments: Iterable[TcpSegment]) -> list[list[Piece]]:
    """Return the pieces of each direction that carries bytes, for all connections."""
    found: dict[object, _Direction] = {}
    for segment in segments:
        found.setdefault((segment.source, segment.target), _Direction()).add(segment)
    for direction in found.values():
        direction.end()
    return [direction.pieces for direction in found.values() if direction.pieces]


def split_pieces(pieces: Iterable[Piece], split: Callable[[], Splitter]) -> Iterator[Chunk]:
    """Yield one chunk for each packet.

    Bytes that belong to no packet become a chunk of the same length that contains zeros.
    """
    stream, t_ns = split(), 0
    for piece in pieces:
        t_ns = piece.t_ns
        if stream.broken or not piece.continues:
            yield from (Chunk(t_ns, bytes(lost.discarded)) for lost in stream.flush())
            stream = split()
        for item in stream.feed(piece.data):
            yield Chunk(t_ns, item if isinstance(item, bytes) else bytes(item.discarded))
    yield from (Chunk(t_ns, bytes(lost.discarded)) for lost in stream.flush())


class _Direction:
    """Reassembly of the bytes in one direction of a connection."""

    def __init__(self) -> None:
        self.pieces: list[Piece] = []
        self._next: int | None = None
        self._broken = False  # whether bytes are missing before the next piece
        self._waiting: dict[int, TcpSegment] = {}

    def add(self, segment: TcpSegment) -> None:
        if segment.begins:
            self.end()
            self._next = None
        if self._next is None:
            self._use(segment, continues=False)
            return

        ahead = (segment.sequence - self._next) % _NUMBERS
        if 0 < ahead < _NUMBERS // 2:
            self._waiting.setdefault(segment.sequence, segment)
            if len(self._waiting) > _MOST_WAITING:
                self._skip_hole()
        else:
            self._use(segment, continues=True)
        self._use_waiting()

    def end(self) -> None:
        """Use all waiting segments in order, and mark the holes between them."""
        while self._waiting:
            self._skip_hole()
            self._use_waiting()

    def _use_waiting(self) -> None:
        while self._next in self._waiting:
            self._use(self._waiting.pop(self._next), continues=True)

    def _skip_hole(self) -> None:
        """Continue with the earliest waiting segment, and mark the hole before it, if any."""
        known = self._next or 0
        first = min(self._waiting, key=lambda sequence: (sequence - known) % _NUMBERS)
        self._use(self._waiting.pop(first), continues=(first - known) % _NUMBERS >= _NUMBERS // 2)

    def _use(self, segment: TcpSegment, *, continues: bool) -> None:
        """Append the bytes of a segment that are not in the stream yet."""
        self._broken |= not continues
        start = self._next if continues and self._next is not None else segment.sequence
        data = segment.payload[(start - segment.sequence) % _NUMBERS :]
        self._next = (start + len(data)) % _NUMBERS
        if data:
            self.pieces.append(Piece(segment.t_ns, data, not self._broken))
            self._broken = False
