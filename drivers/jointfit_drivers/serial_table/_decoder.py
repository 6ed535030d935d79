"""Decoder of the driver serial-table: converts chunks to samples in SI units.

The stamp of a sample is the arrival of its first byte. On a serial line, this is the arrival of the
chunk minus the duration of the frame and of all later bytes in the chunk, at ten bits per byte. On
USB, it is the arrival of the chunk.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no port.
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
    """Return a new codec for the description of a frame or line."""
    return LineCodec(wire) if isinstance(wire, LineFormat) else FrameCodec(wire)


class SerialTableDecoder(SerialMessageDecoder[TableMessage]):
    """Decoder of one serial device.

    Parameters
    ----------
    wire : FrameFormat or LineFormat
        Layout of the device's messages.
    form : SampleForm
        Meaning of the numbers in the messages.
    baud : int, optional
        Line speed, bit/s, from which the arrival of the first byte of a message is computed; None
        for USB.
    """

    def __init__(self, wire: FrameFormat | LineFormat, form: SampleForm, baud: int | None) -> None:
        codec, self._samples = open_codec(wire), RecordSamples(form)
        super().__init__(codec, self._samples, baud, codec.longest)

    @property
    def tick_clock(self) -> TickClock | None:
        """Unit and modulus of the device time; None if the device sends no time."""
        return self._samples.tick_clock

    @override
    def _take(self, message: TableMessage) -> list[Decoded]:
        values, data, end = message
        arrival_ns = self._stamps.stamp(self._codec.fed - end + len(data))
        return self._samples.take(TableRecord(arrival_ns, values, len(data), (data,)))
