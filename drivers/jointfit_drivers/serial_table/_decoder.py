"""Decoder of the serial-table driver: chunks in, samples in SI units out.

A sample is stamped with the arrival of its first byte. On a serial line this is the arrival of the
chunk minus the duration of the frame and of the bytes behind it, at ten bits per byte. On USB it is
the arrival of the chunk.

Invariant: the output depends only on the chunks fed; the decoder reads no clock and no port.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from typing_extensions import override

from jointfit_drivers.serial_decoder import SerialMessageDecoder
from jointfit_drivers.table_samples import RecordSamples, SampleForm, TableRecord
from jointfit_protocols.table import FrameCodec, FrameFormat, LineCodec, LineFormat, TableMessage

if TYPE_CHECKING:
    from jointfit_daemon.model import Decoded, TickClock


def open_codec(wire: FrameFormat | LineFormat) -> FrameCodec | LineCodec:
    """Return a new codec for a description."""
    return LineCodec(wire) if isinstance(wire, LineFormat) else FrameCodec(wire)


class SerialTableDecoder(SerialMessageDecoder[TableMessage]):
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
        codec, self._samples = open_codec(wire), RecordSamples(form)
        super().__init__(codec, self._samples, baud, codec.longest)

    @property
    def tick_clock(self) -> TickClock | None:
        """Unit and modulus of the device time; None without one."""
        return self._samples.tick_clock

    @override
    def _take(self, message: TableMessage) -> list[Decoded]:
        values, data, end = message
        arrival_ns = self._stamps.stamp(self._codec.fed - end + len(data))
        return self._samples.take(TableRecord(arrival_ns, values, len(data), (data,)))
