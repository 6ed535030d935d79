"""Base of decoders of IMUs on a serial line: all but the conversion of one message.

Invariant: the output depends only on the chunks fed; no clock and no port is read.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Generic, Protocol

from jointfit_daemon.model import Corrupt
from jointfit_drivers.serial_conversation import Found_co, Message, StreamCodec
from jointfit_drivers.serial_imu import ArrivalStamps
from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from jointfit_daemon.model import Chunk, Decoded, TickClock
    from jointfit_drivers.checked_samples import CheckedSamples


class CountingCodec(StreamCodec[Found_co], Protocol[Found_co]):
    """Codec of a byte stream that counts, such as a `ResynchronizingCodec`."""

    messages: int

    @property
    def discarded(self) -> int:
        """Bytes without a message so far."""


class SerialDecoder(ABC, Generic[Message]):
    """Decoder of one device; a subclass converts one message.

    A sample is stamped with the arrival of its first byte. After a silence, the rest of an
    incomplete message is not awaited.

    Parameters
    ----------
    codec : CountingCodec
        New codec. Its messages have `size`, bytes on the wire, and `end`, bytes fed up to and
        including the last one.
    samples : CheckedSamples
        New checks; `convert` adds its samples to them.
    baud : int, optional
        Line speed, bit/s, for back-dating of stamps; None for USB, whose bytes take no time.
    longest : int
        Size of the largest message.
    """

    def __init__(
        self,
        codec: CountingCodec[Message],
        samples: CheckedSamples,
        baud: int | None,
        longest: int,
    ) -> None:
        self._codec = codec
        self._stamps = ArrivalStamps(baud, longest)
        self.samples = samples

    @abstractmethod
    def convert(self, message: Message, arrival_ns: int) -> Iterable[Decoded]:
        """Return the samples and events of one message.

        Parameters
        ----------
        message
            Message of the codec.
        arrival_ns
            Arrival of its first byte, monotonic ns.
        """

    @property
    def tick_clock(self) -> TickClock | None:
        """Unit and modulus of the device time; None without one."""
        return self.samples.tick_clock

    @property
    def messages(self) -> int:
        """Well-formed messages so far."""
        return self._codec.messages - self.samples.refused

    @property
    def discarded_bytes(self) -> int:
        """Bytes so far that belong to no message, or to a message that was rejected."""
        return self._codec.discarded + self.samples.refused_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the content that `chunk` completed, in wire order; never raises."""
        out: list[Decoded] = []
        if self._codec.pending and self._stamps.is_silent_before(chunk.t_ns, len(chunk.data)):
            out = self._take(self._codec.flush())
        self._stamps.start_chunk(chunk.t_ns)
        return out + self._take(self._codec.feed(chunk.data))

    def flush(self) -> list[Decoded]:
        """Discard an incomplete message and a sample that waits for confirmation."""
        return self._take(self._codec.flush()) + self.samples.flush()

    def _take(self, found: Sequence[Message | CorruptBytes]) -> list[Decoded]:
        out: list[Decoded] = []
        for item in found:
            if isinstance(item, CorruptBytes):
                out.append(Corrupt(item.discarded, item.reason))
            else:
                since = self._codec.fed - item.end + item.size
                out += self.convert(item, self._stamps.stamp(since))
        return out
