"""Base classes of decoders for IMUs on a serial line. Subclasses convert single messages.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no port.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Generic, Protocol

from typing_extensions import override

from jointfit_daemon.model import Corrupt
from jointfit_drivers.serial_conversation import Found_co, Message, StreamCodec
from jointfit_drivers.serial_imu import ArrivalStamps
from jointfit_protocols.corrupt import CorruptBytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from jointfit_daemon.model import Chunk, Decoded, TickClock
    from jointfit_drivers.checked_samples import CheckedSamples
    from jointfit_drivers.refusals import Refusals


class CountingCodec(StreamCodec[Found_co], Protocol[Found_co]):
    """Codec that counts messages and discarded bytes, such as a `ResynchronizingCodec`."""

    messages: int

    @property
    def discarded(self) -> int:
        """Number of bytes so far that belong to no message."""


class SerialMessageDecoder(ABC, Generic[Message]):
    """Decoder of one device.

    A subclass converts each message in `_take`, and `_arrival_of` returns the stamp of a message.
    After a silence, the decoder discards an incomplete message.

    Parameters
    ----------
    codec : CountingCodec
        New codec. Its messages have the attributes `size`, bytes on the wire, and `end`, bytes fed
        to the codec until the end of the message.
    refusals : Refusals
        Counter of the messages that yielded no sample.
    baud : int, optional
        Line speed, bit/s, from which the arrival of the first byte of a message is computed; None
        for USB, because its bytes arrive together.
    longest : int
        Size of the largest message, bytes.
    """

    def __init__(
        self,
        codec: CountingCodec[Message],
        refusals: Refusals,
        baud: int | None,
        longest: int,
    ) -> None:
        self._codec = codec
        self._refusals = refusals
        self._stamps = ArrivalStamps(baud, longest)

    @abstractmethod
    def _take(self, message: Message) -> Iterable[Decoded]:
        """Return the samples and events of one message."""

    def _take_corrupt(self, found: CorruptBytes) -> list[Decoded]:
        """Return the event of corrupt bytes; a subclass may return further events."""
        return [Corrupt(found.discarded, found.reason)]

    @property
    def messages(self) -> int:
        """Number of messages so far, without rejected messages."""
        return self._codec.messages - self._refusals.refused

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes so far that belong to no message or to a rejected message."""
        return self._codec.discarded + self._refusals.refused_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the samples and events that `chunk` completes, in wire order; never raise."""
        out: list[Decoded] = []
        if self._codec.pending and self._stamps.is_silent_before(chunk.t_ns, len(chunk.data)):
            self._append(self._codec.flush(), out)  # the rest of the message was lost
        self._stamps.start_chunk(chunk.t_ns)

        found = self._codec.feed(chunk.data)
        if len(found) == 1 and type(found[0]) is not CorruptBytes:  # the usual chunk
            out += self._take(found[0])
        else:
            self._append(found, out)
        return out

    def flush(self) -> list[Decoded]:
        """Discard an incomplete message and a sample that waits for confirmation.

        A sample waits if its time or counter contradicts the samples before it. Return the samples
        and events that result.
        """
        out: list[Decoded] = []
        self._append(self._codec.flush(), out)
        return out + self._refusals.flush()

    def _append(self, found: Sequence[Message | CorruptBytes], out: list[Decoded]) -> None:
        for item in found:
            if type(item) is CorruptBytes:  # takes half the time of isinstance()
                out += self._take_corrupt(item)
            else:
                out += self._take(item)

    def _arrival_of(self, message: Message) -> int:
        """Return the arrival of the first byte of `message`, monotonic ns."""
        return self._stamps.stamp(self._codec.fed - message.end + message.size)


class SerialDecoder(SerialMessageDecoder[Message]):
    """Decoder of one device whose samples `CheckedSamples` checks; a subclass converts messages.

    The stamp of a sample is the arrival of the first byte of its message. After a silence, the
    decoder discards an incomplete message.

    Parameters
    ----------
    codec, baud, longest
        As described at `SerialMessageDecoder`.
    samples : CheckedSamples
        Object that checks each sample. `convert` passes its samples to this object.
    """

    def __init__(
        self,
        codec: CountingCodec[Message],
        samples: CheckedSamples,
        baud: int | None,
        longest: int,
    ) -> None:
        super().__init__(codec, samples, baud, longest)
        self.samples = samples

    @abstractmethod
    def convert(self, message: Message, arrival_ns: int) -> Iterable[Decoded]:
        """Return the samples and events of one message.

        Parameters
        ----------
        message
            Message of the codec.
        arrival_ns
            Arrival of the first byte of the message, monotonic ns.
        """

    @property
    def tick_clock(self) -> TickClock | None:
        """Unit and modulus of the device time; None if the device sends no time."""
        return self.samples.tick_clock

    @override
    def _take(self, message: Message) -> Iterable[Decoded]:
        return self.convert(message, self._arrival_of(message))
