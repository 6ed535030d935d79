"""Decoder of the serial-table driver: chunks in, samples in SI units out.

A sample is stamped with the arrival of its first byte. On a serial line this is the arrival of the
chunk minus the duration of the frame and of the bytes behind it, at ten bits per byte. On USB it is
the arrival of the chunk.

Invariant: the output depends only on the chunks fed; the decoder reads no clock and no port.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import Corrupt
from jointfit_drivers.serial_imu import ArrivalStamps
from jointfit_drivers.table_samples import RecordSamples, SampleForm, TableRecord
from jointfit_protocols.table import FrameCodec, FrameFormat, LineCodec, LineFormat, TableMessage

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk, Decoded, TickClock
    from jointfit_protocols.table import TableItem


def open_codec(wire: FrameFormat | LineFormat) -> FrameCodec | LineCodec:
    """Return a new codec for a description."""
    return LineCodec(wire) if isinstance(wire, LineFormat) else FrameCodec(wire)


class SerialTableDecoder:
    """Decoder of one serial device.

    Parameters
    ----------
    wire : FrameFormat or LineFormat
        Description of its messages.
    form : SampleForm
        Meaning of their numbers.
    baud : int, optional
        Line speed, bit/s, for back-dating of stamps; None for USB.
    """

    def __init__(self, wire: FrameFormat | LineFormat, form: SampleForm, baud: int | None) -> None:
        self._codec = open_codec(wire)
        self._samples = RecordSamples(form)
        self._stamps = ArrivalStamps(baud, self._codec.longest)

    @property
    def tick_clock(self) -> TickClock | None:
        """Unit and modulus of the device time; None without one."""
        return self._samples.tick_clock

    @property
    def messages(self) -> int:
        """Well-formed messages so far."""
        return self._codec.messages - self._samples.refused

    @property
    def discarded_bytes(self) -> int:
        """Bytes so far that belong to no message, or to a message that was rejected."""
        return self._codec.discarded + self._samples.refused_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the content that `chunk` completed, in wire order; never raises."""
        out: list[Decoded] = []
        if self._codec.pending and self._stamps.is_silent_before(chunk.t_ns, len(chunk.data)):
            out = self._take(self._codec.flush())  # the rest of the message was lost
        self._stamps.start_chunk(chunk.t_ns)
        found = self._codec.feed(chunk.data)
        return out + self._take(found) if found else out

    def flush(self) -> list[Decoded]:
        """Discard a pending message and a sample that waits for confirmation."""
        return self._take(self._codec.flush()) + self._samples.flush()

    def _take(self, found: list[TableItem]) -> list[Decoded]:
        out: list[Decoded] = []
        for item in found:
            if not isinstance(item, TableMessage):
                out.append(Corrupt(item.discarded, item.reason))
                continue
            values, data, end = item
            arrival_ns = self._stamps.stamp(self._codec.fed - end + len(data))
            out += self._samples.take(TableRecord(arrival_ns, values, len(data), (data,)))
        return out
