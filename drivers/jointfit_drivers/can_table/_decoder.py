"""Decoder of the driver can-table: converts records of CAN frames to samples in SI units.

The stamp of a sample is the arrival of its first frame, because arbitration may delay the later
frames. A chunk contains records of 24 bytes. A record contains a CAN frame, an error frame of the
controller, or the number of frames or bytes that this host lost.

Invariant: the output depends only on the chunks fed. The decoder reads no clock and no bus.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from jointfit_daemon.model import DeviceEvent
from jointfit_daemon.name_lists import list_names
from jointfit_drivers.bus_events import BusEvents
from jointfit_drivers.table_samples import RecordSamples, SampleForm, TableRecord
from jointfit_protocols import can
from jointfit_protocols.corrupt import CorruptBytes
from jointfit_protocols.table import CanTable, CanTableCodec

if TYPE_CHECKING:
    from jointfit_daemon.model import Chunk, Decoded, TickClock

_HALVED = 20
"""Number of incomplete samples, before the first complete sample, that causes a warning."""
_UNMATCHED = 200
"""Number of frames with unknown values of the multiplexer, before the first complete sample, that
causes a warning."""
_LISTED = 6
"""Largest number of frame names in a warning."""


class CanTableDecoder:
    """Decoder of one CAN device.

    Parameters
    ----------
    table : CanTable
        Layout of the device's frames.
    form : SampleForm
        Meaning of the numbers in the frames.
    """

    def __init__(self, table: CanTable, form: SampleForm) -> None:
        self._codec = CanTableCodec(table)
        self._samples = RecordSamples(form)
        self._size = can.RECORD_BYTES * len(table.keys)
        self._bus = BusEvents()
        self._never_complete = True

    @property
    def tick_clock(self) -> TickClock | None:
        """Unit and modulus of the device time; None if the device sends no time."""
        return self._samples.tick_clock

    @property
    def messages(self) -> int:
        """Number of well-formed frames received from this device."""
        return self._codec.messages - self._samples.refused

    @property
    def discarded_bytes(self) -> int:
        """Number of bytes in rejected records, plus adapter bytes that formed no frame."""
        return self._bus.discarded_bytes + self._samples.refused_bytes

    def feed(self, chunk: Chunk) -> list[Decoded]:
        """Return the samples and events that `chunk` completes, in wire order; never raise."""
        out: list[Decoded] = []
        for item in can.unpack_frames(chunk.data):
            if not isinstance(item, can.CanFrame):
                out.append(self._bus.discard(item.discarded, item.reason))
                continue
            if item.error:
                out += self._bus.add_error_frame(item)
                continue
            sample = self._codec.feed(item)
            if sample is None:
                continue
            if isinstance(sample, CorruptBytes):
                out.append(self._bus.discard(can.RECORD_BYTES, sample.reason))
                continue
            self._never_complete = False
            t_ns, values, data = sample
            out += self._samples.take(TableRecord(t_ns, values, self._size, data))
        codec = self._codec
        if self._never_complete and (
            codec.incomplete >= _HALVED or (codec.unmatched >= _UNMATCHED and codec.absent)
        ):
            self._never_complete = False
            out.append(DeviceEvent("warning", self._reason()))
        return out

    def _reason(self) -> str:
        """Return the reason why no sample is complete, with its remedy."""
        absent = self._codec.absent
        if not absent:
            return _INCOMPLETE
        text = f"no complete sample, because {list_names(absent, _LISTED)} never arrived"
        if not self._codec.unmatched:
            return f"{text}: switch the frames on in the device, or correct `ids`"
        return (
            f"{text}; {self._codec.unmatched} frames have these identifiers, but other values of "
            "the multiplexer: correct `starts_with` or `dbc`, or switch the frames on in the device"
        )

    def flush(self) -> list[Decoded]:
        """Discard an incomplete sample; reject a sample that waits for confirmation.

        Return the events that result.
        """
        self._codec.flush()
        return self._samples.flush()


_INCOMPLETE = (
    f"no complete sample after {_HALVED} incomplete samples: correct `sequence` if the device "
    "sends the frames in another order; correct `rate_hz` if a sample takes longer than half a "
    "period"
)
